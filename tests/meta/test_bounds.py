# SPDX-License-Identifier: MIT
"""The numbers of the table of bounds that follow from others."""

from dataclasses import replace
from fractions import Fraction

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from conformance.answers.by_stage import expect
from conformance.answers.expected import largest
from conformance.answers.frame import detail_errors
from conformance.answers.network import expect_with_weights, variants
from conformance.answers.port_arithmetic import Arithmetic, reach, sum_error
from conformance.answers.warp import within_frame
from conformance.cases.large_inputs import frame_case, network_case
from conformance.cases.stage_inputs import make_weights
from conformance.judging.judge import Judge
from conformance.protocol.reference_copy import load, returns
from conformance.protocol.stages import network_inputs
from conformance.reference_port import ReferencePort
from conformance.tolerance import BOUNDS, worst
from stss_ref.constants import HOLE_FILLS
from stss_ref.detail import detail
from tests.meta.right_ports import cook_toom


def amplification(outputs, points):
    """How much more noise Winograd's products bring than direct ones, in rms, for white images and weights: spec docs/conformance.md.

    A product of transformed numbers is rounded relative to itself, and the output transform adds those errors up.
    """
    a, g, b = cook_toom(outputs, tuple(map(Fraction, points)))
    products = np.outer((g * g).sum(axis=1), (g * g).sum(axis=1)) * np.outer((b * b).sum(axis=1), (b * b).sum(axis=1))
    noise = (a * a) @ products @ (a * a).T
    return float(np.sqrt(noise.mean() / 9))


OURS = 0, "5/8", "-5/8", "3/2", "-3/2"


@pytest.mark.parametrize(("outputs", "points", "most"), [(2, (0, 1, -1), 2), (4, (0, 1, -1, 2, -2), 12), (4, OURS, 5.4)])
def test_the_row_for_winograd(outputs, points, most):
    """Covers F(4x4) on the points that most ports take; F(2x2) and our points lose less than half of that."""
    assert amplification(outputs, points) <= most <= BOUNDS["layer.winograd"].roundings


def test_bfloat16_is_rounded_to_the_nearest_ties_to_even():
    numbers = np.array([1 + 2.0**-8, 1 + 3 * 2.0**-8, 1 + 2.0**-7, 3.4e38, -np.inf, np.nan], np.float32)
    largest = (2 - 2.0**-7) * 2.0**127
    want = [1, 1 + 2.0**-6, 1 + 2.0**-7, largest, -np.inf, np.nan]
    np.testing.assert_array_equal(Arithmetic("bfloat16").rounded(numbers), np.array(want, np.float32))


def detail_of(first, frames, offs=(0, 0, 0), unit="float32"):
    """What ``detail`` is in float64; the most that a port's may be off, by its own rounding and by its motion's; where all motions
    surely lead into the frame, or out of it."""
    exact = [[a.astype(np.float64) for a in frame] for frame in frames]
    arithmetic, stencil = Arithmetic(unit), np.zeros(first.shape[:2])
    places = [reach(m, arithmetic, off) for (_, m, _), off in zip(exact, offs, strict=False)]
    within = [within_frame(at) for at in places]
    frames_there = [
        (color, at, numbers, inside) for (color, _, numbers), at, (inside, _) in zip(exact, places, within, strict=True)
    ]
    sure = ~np.any([unsure for _, unsure in within], axis=0)
    return detail(first.astype(np.float64), stencil, exact), *detail_errors(first, stencil, frames_there, arithmetic), sure


@hypothesis.settings(max_examples=200, deadline=None, database=None)
@hypothesis.given(
    st.integers(0, 2**32 - 1), st.sampled_from([1, 8, 40]), st.sampled_from([0, 0, 100]), st.sampled_from(["float32", "float16"]),
    st.sampled_from([(1, 1), (-1, -1), (-1, 1)]), st.booleans(),
)  # fmt: skip
def test_motion_that_is_off_by_its_rounding_keeps_detail_within_the_bound(seed, far, level, unit, ways, all_alike):
    """On the kinks of the tents and beside them, equally often; the reference in float32 stays within its part."""
    random, size = np.random.default_rng(seed), (8, 40)
    first, *colors = (np.round(random.random((4, *size, 3)), random.integers(0, 3)) + level).astype(np.float32)
    fractions = np.where(
        random.random((3, *size, 2)) < 0.5, random.integers(0, 4, (3, *size, 2)) / 4, random.random((3, *size, 2))
    )
    motions = (np.round(random.uniform(-far, far, fractions.shape)) + fractions).astype(np.float32)
    frames = [*zip(colors, motions, (random.random((3, *size)) < 0.2).astype(np.float32), strict=True)]
    offs = [sum_error(motion.astype(np.float64), 1, Arithmetic(unit)) for motion in motions]
    shares = random.choice(ways, (3, *size, 2)) * (1 if all_alike else random.random((3, *size, 2)))
    want, rounded, moved, sure = detail_of(first, frames, offs, unit)
    off = [(c, m + share * off, numbers) for (c, m, numbers), share, off in zip(frames, shares, offs, strict=True)]
    assert worst(np.abs(detail_of(first, off)[0] - want)[sure], moved[sure] + 1e-14) <= 1
    assert unit == "float16" or worst(np.abs(detail(first, np.zeros(size, np.float32), frames) - want), rounded) <= 1


def test_a_motion_that_is_off_by_a_little_more_is_beyond_it():
    """White samples over black, on the kink where the pixel's own colour is all that counts: slope 8.9, of 10.7 that are allowed."""
    black, white, motion, off = (
        np.zeros((1, 9, 3)),
        np.ones((1, 9, 3)),
        np.broadcast_to([0.75, 0], (1, 9, 2)),
        np.array([1e-4, 0]),
    )
    weights_sum = np.zeros((1, 9))
    want, _, most, _ = detail_of(black, [(white, motion, weights_sum)], [np.broadcast_to(off, (1, 9, 2))])
    moved = [worst(np.abs(detail_of(black, [(white, motion - k * off, weights_sum)])[0] - want), most) for k in (1, 1.25)]
    assert 0.8 < moved[0] <= 1 < moved[1]


@pytest.mark.parametrize("steps", [(1, 3, 5), (0, 2, 4)])
@pytest.mark.parametrize("size", [(3, 300), (8, 200), (16, 16)])
def test_the_image_holds_the_rounding_of_a_long_motion(size, steps):
    """The bound is at least the error of a sum in any order, and less than that of half precision."""
    random, arithmetic = np.random.default_rng(2), Arithmetic()
    inputs, weights = frame_case(size, random, "detail", steps)
    moves = random.uniform(-0.45, 0.45, (max(steps), 1, 1, 2)).astype(np.float32) * np.float32(size[::-1])
    inputs |= {"motions": np.broadcast_to(moves, (max(steps), *size, 2)), "positions": inputs["positions"] * 0}
    inputs = {name: array if name == "steps" else array.astype(np.float64) for name, array in inputs.items()}
    right = expect("frame", inputs, weights, arithmetic, {})["image"]
    still = expect_with_weights("network", network_inputs(inputs, weights), weights, arithmetic)["image"]
    assert min(right.allowed / still.allowed, right.rms / still.rms) > 1.05

    def against_bound(change):
        port = load("moved", returns("frame.motion_by_step", lambda motions: {s: change(m, s) for s, m in motions.items()}))
        image = port.run("frame", inputs, weights)["image"]
        return max(largest(right, image), right.together(image))

    for way in (1, -1):
        assert 0 < against_bound(lambda m, step, way=way: m + way * (step - 1) * sum_error(m, 1, arithmetic)) < 0.5
    assert against_bound(lambda m, _: m.astype(np.float16).astype(np.float64)) > 1


def test_the_order_of_tensors_changes_no_bound():
    """A port is given them in another order than the reference."""
    inputs, weights = network_case("encoder", (8, 8), np.random.default_rng(0))
    inputs = {name: np.asarray(array, np.float64) for name, array in inputs.items()}
    turned = replace(weights, tensors={name: weights[name] for name in reversed([*weights])})
    one, other = (expect_with_weights("encoder", inputs, each, Arithmetic("float32")) for each in (weights, turned))
    assert {name: (each.allowed, each.rms) for name, each in one.items()} == {
        name: (each.allowed, each.rms) for name, each in other.items()
    }


def test_weights_that_share_their_arrays_are_changed_once():
    """Weights of other choices have the same bounds; one with another tensor has its own, whatever was asked before."""
    inputs, _ = network_case("history", (8, 16), np.random.default_rng(0))
    judge = Judge(ReferencePort())
    one, other = (make_weights("random", 1, fill=fill) for fill in HOLE_FILLS[:2])
    bias = {"lowlevelGated.conv_feature.bias": one["lowlevelGated.conv_feature.bias"] + np.float32(100)}
    first, again, another = (judge.right("history", inputs, each)["feature"] for each in (one, other, one | bias))
    first_variants, again_variants, other_variants = (variants(each, Arithmetic("float32")) for each in (one, other, one | bias))
    assert again_variants is first_variants
    assert other_variants is not first_variants
    assert again.allowed == first.allowed
    np.testing.assert_array_equal(again.want, first.want)
    assert another.allowed > 2 * first.allowed
    assert np.abs(another.want - first.want).max() > 10


@pytest.mark.parametrize("dtype", ["float32", "float16", "bfloat16"])
def test_weights_too_small_to_be_normal_are_0(dtype):
    arithmetic = Arithmetic(dtype)
    small = np.array([arithmetic.tiny / 2, -arithmetic.spacing, arithmetic.tiny, 0, 1], np.float32)
    np.testing.assert_array_equal(arithmetic.normal(small), np.array([0, 0, arithmetic.tiny, 0, 1], np.float32))
    kept = small[2:].copy()
    assert (arithmetic.normal(kept) is kept) == (dtype == "float32")
