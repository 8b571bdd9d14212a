# SPDX-License-Identifier: MIT
"""A mistake in one layer is found in that layer, for any port that returns layers, and for few of them."""

import subprocess
import sys

import numpy as np
import pytest

from conformance.answers.expected import Expected
from conformance.explain.first_layer import first_departure
from conformance.judging.findings import DepartureError, Finding
from conformance.judging.judge import Judge, Tier, agreement
from conformance.mistakes import find
from conformance.protocol import FolderPort, PortError
from conformance.protocol.job_folder import JobError, read_layers, write_job
from conformance.protocol.layers import LAYERS_OF
from conformance.protocol.reference_copy import reference_layers
from conformance.suite.run_suite import run_suite
from stss.port import ReferencePort, run_job
from stss_ref.weights import LAYERS
from tests.meta.samples import samples

NAMES = [layer.name for layer in LAYERS]


class MangledPort(ReferencePort):
    """The reference, with the taps of one layer's window upside down, or in ``outc``, which has no window, its outputs."""

    def __init__(self, layer, only=None):
        self.layer, self.only = layer, only

    def _given(self, weights):
        names = [name for name in weights if name.startswith(f"{self.layer}.") and name.endswith("weight") and "mask" not in name]
        return weights | {name: weights[name][::-1] if self.layer == "outc" else weights[name][:, :, ::-1] for name in names}

    def run(self, stage, inputs, weights=None):
        return super().run(stage, inputs, self._given(weights))

    def layers(self, stage, inputs, weights=None):
        layers_of = super().layers(stage, inputs, self._given(weights))
        return layers_of if self.only is None else {name: layers_of[name] for name in self.only}


def words(port, stage="network", sample=0):
    case, judge = samples(stage)[sample], Judge(port)
    with pytest.raises(DepartureError) as error:
        judge.check(agreement, case)
    return first_departure(judge, error.value.finding)


@pytest.mark.parametrize("name", NAMES)
def test_each_layer_is_named_where_the_mistake_is_in_it(name):
    message = words(MangledPort(name))
    assert message.startswith(f"first departs at layer {name}: error / bound ")
    assert ("before it" in message) == (name != NAMES[0])


def test_of_few_layers_the_first_behind_the_mistake_is_named():
    few = ["conv1", "down2.downsample", "up1.conv.double_conv.0"]
    message = words(MangledPort("down1.conv2", few))
    assert message.startswith("first departs at layer down2.downsample: ")
    assert message.endswith("; conv1 before it is right")


def test_what_the_network_is_given_comes_first():
    """A mistake before the network: the history of stage frame in the wrong order."""
    assert words(find("frame_history_newest_first").port(), "frame").startswith("first departs at layer history: ")


def test_how_sums_are_rounded_begins_at_no_layer():
    """Each number is within its bound there, so no layer departs, nor what comes after the last one."""
    case, judge = samples("decoder")[0], Judge(ReferencePort())
    got = judge.run(case.stage, case.inputs, case.weights)["image"]
    assert first_departure(judge, Finding("", case, "rounding", got, Expected(got, 0.0))) == ""


def test_what_lies_behind_all_layers_is_not_one_of_them():
    """The decoder's base upsampled on the wrong grid: every layer is right."""
    assert words(find("decoder_base_by_corners").port()) == (
        "none of the 35 layers that the port returns departs, so what comes after outc does"
    )


@pytest.mark.parametrize(
    ("stage", "layers", "message"),
    [
        ("encoder", dict, "the port returns no layers"),
        (
            "network",
            lambda: {"conv1": np.zeros((1, 1, 24), np.float32)},
            "its layers cannot be read: conv1: expected shape (16, 24, 24), got (1, 1, 24)",
        ),
        ("network", lambda: 1 / 0, "its layers cannot be read: ZeroDivisionError: division by zero"),
    ],
)
def test_layers_that_lack_or_are_wrong(stage, layers, message):
    port = MangledPort("conv1")
    port.layers = lambda *_: layers()
    assert words(port, stage).startswith(message)


def test_the_judge_says_it(monkeypatch):
    """In the message of the failing test, beside the diagnosis of the whole."""
    monkeypatch.setattr("conformance.judging.search.SHRINK_SECONDS", 0.0)  # as small as it gets is no part of this
    results = run_suite(Judge(MangledPort("down1.conv1"), Tier("some", 3, 3)), ["encoder"], first_only=True)
    failure = next(result for result in results if result.outcome == "failed")
    assert "; first departs at layer down1.conv1: " in failure.message
    assert "looks like" in failure.message


def test_every_layer_of_the_table_belongs_to_one_stage():
    parts = [name for stage in ("encoder", "history", "erm", "decoder") for name in LAYERS_OF[stage]]
    assert sorted(parts) == sorted(NAMES)
    assert [name for name in LAYERS_OF["network"] if name != "reshaded"] == NAMES


PROGRAM = [sys.executable, "-m", "stss", "port"]


def test_a_program_hands_them_over_when_asked():
    case = samples("encoder")[0]
    port = FolderPort(PROGRAM, 60)
    layers_of = port.layers("encoder", case.inputs, case.weights)
    want = reference_layers("encoder", case.inputs, case.weights)
    assert list(layers_of) == list(want)
    assert all(np.array_equal(layers_of[name], want[name]) for name in want)


def test_dump(tmp_path):
    """Without the judge's folder no layers are written; files of an earlier run are removed."""
    case = samples("history")[0]
    write_job(tmp_path, [case, samples("warp")[0]])
    run_job(tmp_path, "ref")
    assert not (tmp_path / "0000" / "layers").exists()
    subprocess.run([*PROGRAM, "--dump", str(tmp_path)], check=True)
    assert len(list((tmp_path / "0000" / "layers").iterdir())) == 10
    assert not (tmp_path / "0001" / "layers").exists()
    np.save(tmp_path / "0000" / "layers" / "conv1.npy", np.zeros(3))
    run_job(tmp_path, "ref")
    assert not (tmp_path / "0000" / "layers" / "conv1.npy").exists()


def test_what_a_program_leaves_there_is_checked(tmp_path):
    case = samples("history")[0]
    write_job(tmp_path, [case], layers=True)
    folder = tmp_path / "0000"
    assert read_layers(folder, "history", case.inputs) == {}
    np.save(folder / "layers" / "convHis1.0.npy", np.zeros((3, 2, 2, 24), np.float32))
    with pytest.raises(JobError, match="expected shape"):
        read_layers(folder, "history", case.inputs)
    layers = {**reference_layers("history", case.inputs, case.weights), "feature": np.zeros(3, np.float32)}
    for name in ("convHis1.0", "feature"):  # an output is no layer, and does no harm
        np.save(folder / "layers" / f"{name}.npy", layers[name])
    assert read_layers(folder, "history", case.inputs).keys() == {"convHis1.0"}
    np.save(folder / "layers" / "conv1.npy", np.zeros(3, np.float32))
    with pytest.raises(JobError, match="not a layer of stage history"):
        read_layers(folder, "history", case.inputs)


def test_a_program_that_fails_then_is_told_of():
    case = samples("history")[0]
    with pytest.raises(PortError):
        FolderPort(["false"], 10).layers(case.stage, case.inputs, case.weights)


def test_nothing_is_said_to_come_after_the_last_layer():
    """What all outputs together show may be within the bound of each layer."""
    judge, case = Judge(ReferencePort()), samples("encoder")[0]
    right = judge.right(case.stage, case.inputs, case.weights)["x4"]
    words = first_departure(judge, Finding("", case, "x4", None, right))
    assert words == "each of the 11 layers is within its own bound, and nothing comes after the last one"
