# SPDX-License-Identifier: MIT
"""Stage history."""

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
from conformance.tolerance import BOUNDS
from stss_ref.weights import Weights

CASES = st.tuples(network_inputs("history"), weights())


@cases(CASES, slow=True)
def test_agrees_with_the_reference(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """The feature is the float64 reference's, within the error that rounding can cause."""
    yield from judge.agrees("history", *case)


@cases(st.tuples(CASES, st.permutations(range(3))), slow=True)
def test_the_three_frames_share_their_weights(judge: Judge, case: tuple[tuple[Inputs, Weights], list[int]]) -> Talk:
    """Permuting the frames, and the last layer's inputs from each, changes the result only by rounding."""
    (inputs, weights), order = case
    blocks = np.concatenate([np.arange(32) + 32 * i for i in order])
    permuted = {
        name: tensor[:, blocks] for name, tensor in weights.items() if name.startswith("lowlevelGated") and tensor.ndim == 4
    }
    turned = {"history": inputs["history"][order]}
    whole, got = yield ask("history", inputs, weights), ask("history", turned, weights | permuted)
    right = judge.right("history", inputs, weights)["feature"]
    judge.holds("history.feature", got["feature"], Expected(whole["feature"], 2 * np.asarray(right.allowed)))


@cases(st.tuples(CASES, st.floats(-6, 6, width=16)), slow=True)
def test_without_weights_the_bias_is_left(judge: Judge, case: tuple[tuple[Inputs, Weights], float]) -> Talk:
    """If all weights are 0, the feature is the last layer's bias, times the sigmoid of the gate's bias: no ReLU follows the gate."""
    (inputs, weights), gate = case
    name = "lowlevelGated.conv_feature.bias"
    still = weights.convert(lambda tensor: tensor * 0)
    still |= {name: weights[name], "lowlevelGated.conv_mask.0.bias": np.full(1, gate, np.float32)}
    bias = judge.round_inputs(still)[name].astype(np.float64)
    got = (yield ask("history", inputs, still))["feature"]
    off = (BOUNDS["gate"].roundings + 1) * judge.arithmetic.unit * np.abs(bias) + judge.arithmetic.tiny  # sigmoid and product
    want = np.broadcast_to(bias / (1 + np.exp(-gate)), got.shape)
    judge.holds("history.feature", got, Expected(want, np.broadcast_to(off, got.shape)))


test_the_same_twice = same_twice("history", cases(CASES, slow=True))


test_what_needs_no_rounding_is_exact = agrees_exactly("history", multiples(32))


test_sums_round_either_way = rounds_either_way("history", "feature")


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("history")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("history")


test_a_users_size_agrees_in_windows = agrees_in_windows("history")
