# SPDX-License-Identifier: MIT
"""Stage encoder."""

import numpy as np
from hypothesis import strategies as st

from conformance.answers.expected import Expected
from conformance.cases.stage_inputs import Inputs, multiples, network_inputs, weights
from conformance.judging.judge import Judge
from conformance.judging.questions import Talk, ask
from conformance.suite.properties import (
    agrees_exactly,
    agrees_in_large_frames,
    agrees_in_windows,
    cases,
    keeps_nothing_by_a_part,
    rounds_either_way,
    same_twice,
)
from stss_ref.weights import Weights

CASES = st.tuples(network_inputs("encoder"), weights())
REACH = {"x1": 2, "x2": 7, "x3": 17, "x4": 37}
"""Radius that a pixel of each output depends on, in input pixels: two layers of radius 1 for x1, then three more at each size."""


@cases(CASES, slow=True)
def test_agrees_with_the_reference(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """All four features are the float64 reference's, within the error that rounding can cause."""
    yield from judge.agrees("encoder", *case)


@cases(CASES, slow=True)
def test_what_is_masked_is_read_once(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """If the mask is 0 everywhere, the weights of ``color * mask`` do not change the features."""
    inputs, weights = case
    closed = {**inputs, "mask": inputs["mask"] * 0}
    other = weights | {name: weights[name].copy() for name in ("conv1.conv_feature.weight", "conv1.conv_mask.0.weight")}
    for name in ("conv1.conv_feature.weight", "conv1.conv_mask.0.weight"):
        other[name][:, 6:12] = 0
    right = judge.right("encoder", closed, weights)
    first, second = yield [ask("encoder", closed, w) for w in (weights, other)]
    for name, expected in right.items():
        judge.holds(f"encoder.{name}", second[name], Expected(first[name], 2 * np.asarray(expected.allowed)))


@cases(st.tuples(network_inputs("encoder", multiples(48)), weights(), st.integers(0, 47), st.integers(0, 47)), slow=True)
def test_a_pixel_is_seen_from_nearby_only(judge: Judge, case: tuple[Inputs, Weights, int, int]) -> Talk:
    """Changing one pixel changes nothing beyond the layers' radius; bit for bit, except in a Winograd port."""
    inputs, tensors, y, x = case
    height, width, _ = inputs["color"].shape
    y, x = y % height, x % width
    changed = {**inputs, "color": inputs["color"].copy(), "gbuffer": inputs["gbuffer"].copy()}
    changed["color"][y, x] = 0.75 - changed["color"][y, x] / 2
    changed["gbuffer"][y, x, 4:] = 0.75 - changed["gbuffer"][y, x, 4:] / 2
    right = judge.right("encoder", inputs, tensors)
    first, second = yield [ask("encoder", i, tensors) for i in (inputs, changed)]
    for name, expected in right.items():
        side = height // first[name].shape[0]
        rows, columns = (np.arange(n) * side for n in first[name].shape[:2])
        far = (np.abs(rows - y) > REACH[name] + side)[:, None] | (np.abs(columns - x) > REACH[name] + side)[None]
        want = np.where(far[..., None], first[name], second[name])
        judge.holds(f"encoder.{name}", second[name], Expected(want, 2 * np.asarray(expected.allowed)))


test_the_same_twice = same_twice("encoder", cases(CASES, slow=True))


test_what_needs_no_rounding_is_exact = agrees_exactly("encoder", multiples())


test_sums_round_either_way = rounds_either_way("encoder", "x1")


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("encoder")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("encoder")


test_a_users_size_agrees_in_windows = agrees_in_windows("encoder")
