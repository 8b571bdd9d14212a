# SPDX-License-Identifier: MIT
"""Stage decoder."""

import numpy as np
from hypothesis import strategies as st

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
from stss_ref.weights import Weights, zeros

CASES = st.tuples(network_inputs("decoder"), weights())


@cases(CASES, slow=True)
def test_agrees_with_the_reference(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """The image is the float64 reference's, within the error that rounding can cause."""
    yield from judge.agrees("decoder", *case)


@cases(CASES, slow=True)
def test_each_output_channel_has_its_place(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """If the colour is black and all weights are 0, bias 4c + 2i + j is channel c of the pixels (2y + i, 2x + j), bit for bit."""
    inputs, weights = case
    still = weights.convert(lambda tensor: tensor * 0) | {"outc.bias": weights["outc.bias"]}
    got = (yield ask("decoder", {**inputs, "color": inputs["color"] * 0}, still))["image"]
    bias = judge.round_inputs(still)["outc.bias"].reshape(3, 2, 2).transpose(1, 2, 0)
    judge.same("decoder.image", got, np.tile(bias, (got.shape[0] // 2, got.shape[1] // 2, 1)))


@cases(network_inputs("decoder", color="flat"), slow=True)
def test_one_colour_stays_one_colour(judge: Judge, inputs: Inputs) -> Talk:
    """Without a residual a flat frame is upsampled to the same colour bit for bit."""
    got = (yield ask("decoder", inputs, zeros()))["image"]
    judge.same("decoder.image", got, np.broadcast_to(judge.round_inputs(inputs, "decoder")["color"][:1, :1, :3], got.shape))


test_the_same_twice = same_twice("decoder", cases(CASES, slow=True))


test_what_needs_no_rounding_is_exact = agrees_exactly("decoder", multiples())


test_sums_round_either_way = rounds_either_way("decoder", "image")


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("decoder")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("decoder")


test_a_users_size_agrees_in_windows = agrees_in_windows("decoder")
