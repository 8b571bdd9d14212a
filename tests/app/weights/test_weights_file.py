# SPDX-License-Identifier: MIT
"""Weights as files, their identity, and the table of costs."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from safetensors import numpy as safetensors_numpy
from safetensors import safe_open

from stss.weights import file as files
from stss.weights.file import identity, load, save
from stss.weights.inspect import component_costs, inspect, print_inspection
from stss_cl.liveness import is_tiny
from stss_ground.errors import InputError
from stss_ref.weights import TENSORS, Weights, WeightsError, random, zeros


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "some.safetensors"


def test_saved_weights_come_back_bit_for_bit(path: Path, tmp_path: Path):
    """Equal weights make equal files, whatever their order; one bit of one number changes the identity."""
    save(path, random(1), {"made by": "test", "a": "ä"})
    save(tmp_path / "other.safetensors", dict(reversed([*random(1).items()])), {"a": "ä", "made by": "test"})
    assert path.read_bytes() == (tmp_path / "other.safetensors").read_bytes()
    changed = random(1) | {"outc.bias": np.nextafter(random(1)["outc.bias"], np.float32(1))}
    assert identity(changed) != identity(random(1)) == identity(Weights(dict(reversed([*random(1).items()]))))
    loaded = load(path)
    assert all(np.array_equal(loaded.weights[name], random(1)[name]) for name in TENSORS)
    assert loaded.metadata == {"made by": "test", "a": "ä"}
    assert loaded.source == str(path)
    assert loaded.identity == loaded.label == identity(random(1))
    assert set(safetensors_numpy.load_file(path)) == set(TENSORS)


@pytest.mark.parametrize(
    ("changed", "entries"),
    [
        ({"second_color": "detail"}, {"second_color": "detail", "hole_test": "footprint", "stss_weights_version": "4"}),
        (
            {"hole_fill": "reshade"},
            {"hole_fill": "reshade", "second_color": "newest", "hole_test": "footprint", "stss_weights_version": "5"},
        ),
        ({"hole_test": "paper"}, {"hole_test": "paper", "second_color": "newest", "stss_weights_version": "3"}),
    ],
)
def test_settings_are_in_the_file_and_in_the_identity(path: Path, changed: dict[str, Any], entries: dict[str, str]):
    save(path, replace(random(1), **changed), {"made by": "test"})
    loaded = load(path)
    assert {name: getattr(loaded.weights, name) for name in changed} == changed
    assert loaded.metadata == {"made by": "test"}
    assert loaded.identity == identity(loaded.weights) != identity(random(1))
    with safe_open(path, "numpy") as file:
        assert file.metadata() == {"made by": "test", **entries}


@pytest.mark.parametrize(("metadata", "message"), [
    ({"stss_weights_version": "4"}, r"second_color: expected one of newest, detail in the metadata, found ''"),
    ({"stss_weights_version": "3", "second_color": "detail"}, "second_color: expected one of newest in the metadata, found 'detail'"),
    ({"stss_weights_version": "1", "second_color": "detail"}, "second_color: expected no such entry"),
    ({"stss_weights_version": "3", "second_color": "newest", "hole_test": "none"}, "hole_test: expected one of footprint, paper in"),
    ({"stss_weights_version": "4", "second_color": "newest", "hole_test": "paper", "hole_fill": "reshade"}, "hole_fill: expected no such"),
    ({"stss_weights_version": "5", "second_color": "newest", "hole_test": "paper"}, "hole_fill: expected one of occlusion_warp, reshade"),
    ({"stss_weights_version": "2"}, "expected stss_weights_version 1, 3, 4 or 5 in the metadata, found '2'"),
])  # fmt: skip
def test_unknown_settings_are_refused(path: Path, metadata: dict[str, str], message: str):
    safetensors_numpy.save_file(dict(random(1)), path, metadata)
    with pytest.raises(InputError, match=message):
        load(path)


def test_identity_stays_what_it_was():
    """Runs that are resumed, and reports, compare it with those of earlier versions."""
    assert identity(zeros()) == "8fca74d080362d00aa60b05204d03ef029f9f8c03b2ec12f59ce7d1df5976f6a"


def test_what_is_no_weights_file_is_named(path: Path):
    def refused(message: str, file: Path = path) -> None:
        with pytest.raises((InputError, WeightsError), match=message) as error:
            load(file)
        assert str(error.value).startswith(str(file))

    refused("No such file")
    refused("stss weights import", path.with_suffix(".pkl"))
    refused(
        "expected weights, a .safetensors file or one of realtime, antialiased, bilinear",
        path.with_name("bicubic"),
    )
    save(path, zeros(), {})
    whole = path.read_bytes()
    for keep in (0, 100, -1):
        path.write_bytes(whole[:keep])
        refused("damaged safetensors file")
    safetensors_numpy.save_file(dict(zeros()), path, {"format": "pt"})
    refused("expected stss_weights_version 1, 3, 4 or 5 in the metadata, found")
    safetensors_numpy.save_file({**zeros(), "outc.bias": np.zeros(12, np.float16)}, path, {"stss_weights_version": "1"})
    refused("outc.bias: expected dtype F32, got F16")
    with path.open("wb") as file:
        file.truncate(files.MAX_BYTES + 1)
    refused("larger than 64 MiB")


def test_a_failed_save_leaves_the_old_file_and_nothing_else(path: Path, monkeypatch: pytest.MonkeyPatch):
    save(path, random(1), {})
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        save(path, random(2), {})
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_costs_are_those_of_the_paper():
    """The authors counted at 968 x 544; their 141.00 K is 141.008 cut off."""
    rows = [(row.name, row.parameters, round(row.multiply_adds / 1e9, 2)) for row in component_costs(544, 968)]
    assert rows == [
        ("Backbone", 141_008, 20.53),
        ("HistoryEmbedding", 120_697, 8.78),
        ("ERM", 155_536, 2.20),
        ("Full", 417_241, 31.50),
    ]


def test_inspection_says_what_is_left_out(capsys):
    unread = random(1) | {name: w * 0 for name, w in random(1).items() if name.startswith("lowlevelGated.") and w.ndim == 4}
    for weights, is_told in ((random(1), False), (unread, True)):
        print_inspection(inspect(weights, 540, 960), Console())
        out = " ".join(capsys.readouterr().out.split())
        assert ("left out, since they are 0 or only kernels of 0 read them: convHis1.0, convHis1.2, " in out) == is_told
        assert ("run once, since all their kernels that read a frame are 0: lowlevelGated" in out) == is_told
        assert "second colour: newest, the newest frame" in out
    reader = "up1.conv.double_conv.2.weight"
    print_inspection(inspect(random(1) | {reader: random(1)[reader] * (np.arange(64) < 32)[:, None, None]}, 540, 960), Console())
    assert "units that run: 32 of 64 of up1.conv.double_conv.0" in " ".join(capsys.readouterr().out.split())
    print_inspection(inspect(Weights(unread, "detail"), 540, 960), Console())
    assert "second colour: detail, the details of warped frames" in capsys.readouterr().out


def test_inspection_counts_what_is_taken_for_0(capsys):
    name = "conv1.conv_feature.weight"
    weights = random(1) | {name: np.where(np.arange(9).reshape(3, 3) < 2, np.float32(1e-36), random(1)[name])}
    weights[name][0, 0, 0, 0] = 1e-40
    inspected = inspect(weights, 540, 960)
    assert (inspected.tiny, inspected.subnormal) == (24 * 21 * 2, 1)
    print_inspection(inspected, Console())
    assert "taken for 0: 1008 numbers below 8e-31, of which 1 are subnormal" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("name", ["realtime", "antialiased"])
def test_the_weights_that_come_with_the_program_have_nothing_tiny(name: str):
    assert not any(is_tiny(tensor).any() for tensor in load(name).weights.values())


@pytest.mark.parametrize("name", ["realtime", "antialiased"])
def test_the_weights_that_come_with_the_program(name: str):
    """They are there, are no zero residual, and say where they are from."""
    loaded = load(name)
    assert loaded.weights["outc.weight"].any()
    assert loaded.label == f"{name} {loaded.identity}"

    def runs(metadata):
        parts = metadata.get("average_of", [])
        parts = json.loads(parts) if isinstance(parts, str) else parts
        return [run for part in parts for run in runs(part)] if parts else [metadata]

    assert all({"settings", "steps"} <= set(run) for run in runs(loaded.metadata))
