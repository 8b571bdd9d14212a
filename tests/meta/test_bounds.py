# SPDX-License-Identifier: MIT
"""The numbers of the table of bounds that follow from others."""

from fractions import Fraction

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from conformance.answers.by_stage import expect
from conformance.answers.expected import largest
from conformance.answers.frame import Seen, detail_errors
from conformance.answers.network import expect_with_weights
from conformance.answers.port_arithmetic import Arithmetic, reach, sum_error
from conformance.cases.stage_inputs import made_weights
from conformance.protocol.reference_copy import load, returns
from conformance.protocol.stages import network_inputs
from conformance.tolerance import BOUNDS, worst
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


@pytest.mark.parametrize(("outputs", "points", "expected"), [(2, (0, 1, -1), 2), (4, (0, 1, -1, 2, -2), 12)])
def test_the_row_for_winograd(outputs, points, expected):
    """Covers F(4x4) on the points that most ports take; F(2x2) and better points lose less."""
    assert amplification(outputs, points) <= expected <= BOUNDS["layer.winograd"].roundings


def test_our_own_points_lose_less():
    ours = (0, Fraction(5, 8), Fraction(-5, 8), Fraction(3, 2), Fraction(-3, 2))
    assert amplification(4, ours) < amplification(4, (0, 1, -1, 2, -2)) / 2


def test_bfloat16_is_rounded_to_the_nearest_ties_to_even():
    given = np.array([1 + 2.0**-8, 1 + 3 * 2.0**-8, 1 + 2.0**-7, 3.4e38, -np.inf, np.nan], np.float32)
    largest = (2 - 2.0**-7) * 2.0**127
    want = [1, 1 + 2.0**-6, 1 + 2.0**-7, largest, -np.inf, np.nan]
    np.testing.assert_array_equal(Arithmetic("bfloat16").rounded(given), np.array(want, np.float32))


def looked(seed, far, colors, unit):
    """A first colour, and three frames of 3 x 40: numbers that float32 has, on the kinks of the tents as often as beside them."""
    random, size = np.random.default_rng(seed), (3, 40)
    draw = {
        "noise": random.random,
        "black and white": lambda n: random.integers(0, 2, n),
        "ramp": lambda n: np.indices(n)[-2] / 40,
    }
    first, *others = (draw[colors]((*size, 3)).astype(np.float32) for _ in range(4))
    whole, quarters = np.round(random.uniform(-far, far, (3, *size, 2))), random.integers(0, 4, (3, *size, 2)) / 4
    motions = (whole + np.where(random.random(quarters.shape) < 0.5, quarters, random.random(quarters.shape))).astype(np.float32)
    frames = [*zip(others, motions, random.random((3, *size)) < 0.8, strict=True)]
    offs = [sum_error(motion.astype(np.float64), 1, Arithmetic(unit)) for motion in motions]
    return first, frames, offs, random


def in_double(first, frames):
    return detail(
        first.astype(np.float64), [(color.astype(np.float64), m.astype(np.float64), valid) for color, m, valid in frames]
    )


def allowed(first, frames, offs, unit="float32"):
    seen = [
        Seen(color, reach(motion.astype(np.float64), Arithmetic(unit), off), valid, 0)
        for (color, motion, valid), off in zip(frames, offs, strict=True)
    ]
    return detail_errors(first, seen, Arithmetic(unit))


@hypothesis.settings(max_examples=200, deadline=None, database=None)
@hypothesis.given(
    st.integers(0, 2**32 - 1), st.sampled_from([1, 8, 40]), st.sampled_from(["noise", "black and white", "ramp"]),
    st.sampled_from(["float32", "float16"]), st.sampled_from(["up", "down", "either", "any"]),
)  # fmt: skip
def test_no_motion_that_is_off_by_its_rounding_takes_detail_beyond_the_bound(seed, far, colors, unit, way):
    first, frames, offs, random = looked(seed, far, colors, unit)
    ways = {"up": np.ones, "down": lambda n: -np.ones(n), "either": lambda n: random.choice([-1, 1], n)}
    by = ways.get(way, lambda n: random.uniform(-1, 1, n))
    moved = [(c, m + by(off.shape) * off, valid) for (c, m, valid), off in zip(frames, offs, strict=True)]
    ratio = worst(in_double(first, moved) - in_double(first, frames), allowed(first, frames, offs, unit).moved + 1e-14)
    hypothesis.target(ratio)
    assert ratio <= 1
    own = detail(first, frames) - in_double(first, frames)
    assert worst(np.abs(own), allowed(first, frames, [0, 0, 0]).rounded) <= 1


def test_a_motion_that_is_off_by_a_little_more_is_beyond_it():
    """White samples over black, on the kink where the pixel's own colour is all that counts: slope 8, of 10.7 that are allowed."""
    size, off = (1, 9), np.array([1e-4, 0])
    frame = np.ones((*size, 3)), np.broadcast_to([0.75, 0], (*size, 2)), np.indices(size)[1] < 5
    most = allowed(np.zeros((*size, 3)), [frame], [np.broadcast_to(off, (*size, 2))]).moved
    moved = [worst(np.abs(in_double(frame[0] * 0, [(frame[0], frame[1] - k * off, frame[2])]) - in_double(frame[0] * 0, [frame])), most)
             for k in (1, 1.25)]  # fmt: skip
    assert 0.8 < moved[0] <= 1 < moved[1]


@pytest.mark.parametrize("kind", ["random", "sparse"])
@pytest.mark.parametrize(("size", "steps"), [((3, 300), (1, 3, 5)), ((8, 200), (0, 2, 4)), ((16, 16), (1, 3, 5))])
def test_the_image_holds_the_rounding_of_a_long_motion(size, steps, kind):
    """As much as a sum may be off, either way; not as much as half precision is."""
    random, single = np.random.default_rng(2), np.float32
    moves = random.uniform(-0.45, 0.45, (max(steps), 1, 1, 2)).astype(single) * single(size[::-1])
    inputs = {
        "colors": random.integers(0, 2, (3, *size, 3)), "steps": np.array(steps, np.int32), "nov": np.ones(size),
        "motions": np.broadcast_to(moves, (max(steps), *size, 2)), "gbuffer": random.random((*size, 9)),
        "stencils": np.zeros((4, *size)), "normals": np.ones((4, *size, 3)), "positions": np.zeros((4, *size, 3)),
    }  # fmt: skip
    inputs = {name: array if name == "steps" else array.astype(np.float64) for name, array in inputs.items()}
    weights, arithmetic = made_weights(kind, 0, "detail"), Arithmetic()
    right = expect("frame", inputs, weights, arithmetic, {})["image"]
    still = expect_with_weights("network", network_inputs(inputs, weights), weights, arithmetic)["image"]
    assert 1.05 < right.allowed / still.allowed < 10
    assert 1.05 < right.rms / still.rms < 40

    def against_bound(change):
        port = load("moved", returns("frame.motion_by_step", lambda motions: {s: change(m, s) for s, m in motions.items()}))
        image = port.run("frame", inputs, weights)["image"]
        return max(largest(right, image), right.together(image))

    for way in (1, -1):
        assert 0 < against_bound(lambda m, step, way=way: m + way * (step - 1) * sum_error(m, 1, arithmetic)) < 0.5
    assert against_bound(lambda m, _: m.astype(np.float16).astype(np.float64)) > 1
