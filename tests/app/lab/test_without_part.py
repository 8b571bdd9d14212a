# SPDX-License-Identifier: MIT
"""The network without a part: that is removed, and nothing else."""

from __future__ import annotations

import json

import numpy as np
import pytest

from stss.demo import write_demo_sequence
from stss.frames.backends import ReferenceBackend
from stss.frames.supersampler import Supersampler
from stss.sequence.reader import open_sequence
from stss.weights.file import save
from stss_lab.baselines.without_part import CHANGES, ERM, WithoutPart, network
from stss_ref import weights as table
from stss_ref.frame import NetworkInputs
from stss_ref.network import network as whole_network
from tests.hostile.cases import call

H, W = 20, 28


def draw_inputs(seed=0):
    """The network's inputs, of noise."""
    random = np.random.default_rng(seed).random
    shapes = {"color": (H, W, 6), "gbuffer": (H, W, 9), "mask": (H, W), "history": (3, H, W, 4)}
    return NetworkInputs(**{name: random(shape, np.float32) for name, shape in shapes.items()})


def test_the_whole_is_stage_network():
    weights, inputs = table.random(1), draw_inputs()
    expected = whole_network(inputs.color, inputs.gbuffer, inputs.mask, inputs.history, weights)
    np.testing.assert_array_equal(network(inputs, weights, mean_erm=False), expected)
    assert (network(inputs, weights, mean_erm=True) != expected).any()


@pytest.mark.parametrize(
    ("part", "field"), [("history", "history"), ("mask", "mask"), ("gbuffer", "gbuffer"), ("second", "color")]
)
def test_a_part_is_what_only_it_shows(part, field):
    """Two inputs that differ in that part alone become one; the other inputs stay."""
    first, second = draw_inputs(0), draw_inputs(1)
    changed = CHANGES[f"without-{part}"](first)
    for name in ("color", "gbuffer", "mask", "history"):
        assert np.array_equal(getattr(changed, name), getattr(first, name)) == (name != field), name
    if part == "history":  # the newest frame stays, and so does the first colour
        second.history[-1] = first.history[-1]
    if part == "second":
        second.color[..., :3] = first.color[..., :3]
    np.testing.assert_array_equal(getattr(CHANGES[f"without-{part}"](second), field), getattr(changed, field))
    assert getattr(changed, field).shape == getattr(first, field).shape


def test_an_erm_that_says_the_same_everywhere_is_its_mean():
    """Light without weights, and nothing masked: all places gather one colour."""
    weights, inputs = table.random(2), CHANGES["without-mask"](draw_inputs())
    flat = weights | {"latentEncoder.4.weight": np.zeros_like(weights["latentEncoder.4.weight"])}
    images = [network(inputs, flat, mean_erm=mean) for mean in (False, True)]
    np.testing.assert_allclose(*images, atol=1e-5)  # a mean of equal values rounds
    others = [network(inputs, weights, mean_erm=mean) for mean in (False, True)]
    assert np.abs(others[0] - others[1]).max() > 1e-3


def test_the_command(tmp_path):
    """A row for each part; weights that read nothing lose nothing, and others lose by each part another score."""
    write_demo_sequence(tmp_path / "demo", 8, (16, 24))
    save(tmp_path / "some.safetensors", table.random(3), {})
    sequence = tmp_path / "demo" / "frames", tmp_path / "demo" / "truth"
    words = ["methods", *sequence, "-o", tmp_path / "out", "--frames", "6:7", "--json", "--overwrite", "--methods"]

    def scores(names, *weights):
        printed = call(*words, ",".join(names), *weights)
        assert printed.returncode == 0, printed.stderr
        return {name: scores["means"]["EF"]["all"]["psnr_rgb"] for name, scores in json.loads(printed.stdout).items()}

    plain = scores(CHANGES, "--weights", "bilinear")
    assert list(plain) == [*CHANGES]
    assert len({*plain.values()}) == 1
    assert len({*scores(["without-gbuffer", ERM], "--weights", tmp_path / "some.safetensors").values(), *plain.values()}) == 3


def test_images_are_mixed_where_those_of_the_whole_are(tmp_path):
    """So a part that the weights do not read brings nothing, mixed or not."""
    write_demo_sequence(tmp_path / "demo", 8, (16, 24))
    words = ["methods", tmp_path / "demo" / "frames", tmp_path / "demo" / "truth", "-o", tmp_path / "out", "--frames", "6:7"]
    words += ["--json", "--overwrite", "--backend", "ref", "--weights", "realtime", "--methods", "network,without-history"]

    def scores(*option):
        printed = call(*words, *option)
        assert printed.returncode == 0, printed.stderr
        return [row["means"]["EF"]["all"]["psnr_rgb"] for row in json.loads(printed.stdout).values()]

    (mixed, part), (plain, plain_part) = scores(), scores("--no-accumulate")
    assert (part, plain_part) == (mixed, plain)
    assert mixed != plain


def test_the_backend_reports_the_holes_of_the_whole(write_frames):
    """The removed mask is the network's, not that of the scores."""
    files = open_sequence(write_frames(range(6), rendered=range(0, 6, 2), size=(16, 24)), "stss")
    frames = [files.load(number) for number in range(6)]
    weights = table.random(1)
    backends = ReferenceBackend(weights), *(WithoutPart(weights, method) for method in ("without-mask", ERM))
    valid = [[output.valid for output in Supersampler(backend=backend)(frames)] for backend in backends]
    for other in valid[1:]:
        np.testing.assert_array_equal(other, valid[0])
    assert not np.all(valid[0])
