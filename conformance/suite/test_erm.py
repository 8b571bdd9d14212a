# SPDX-License-Identifier: MIT
"""Stage erm."""

import numpy as np
from hypothesis import strategies as st

from conformance.answers.expected import Expected
from conformance.cases.planes import SEEDS
from conformance.cases.stage_inputs import Inputs, multiples, network_inputs, weights
from conformance.judging.judge import Judge
from conformance.judging.questions import Talk, ask
from conformance.suite.properties import (
    agrees_in_large_frames,
    agrees_in_windows,
    agrees_on_constants,
    cases,
    keeps_nothing_by_a_part,
    rounds_either_way,
    same_twice,
)
from stss_ref.weights import Weights

LONG = 1024.0
"""A key: its square is larger than all numbers of float16."""
CASES = st.tuples(network_inputs("erm", multiples(48)), weights())


@cases(CASES, slow=True)
def test_agrees_with_the_reference(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """The reshaded light is the float64 reference's, within the error that rounding can cause."""
    yield from judge.agrees("erm", *case)


@cases(CASES, slow=True)
def test_nothing_to_be_trusted_gives_nothing(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """If the whole window is masked, the result is 0, and not 0 / 0."""
    inputs, weights = case
    got = (yield ask("erm", {**inputs, "mask": inputs["mask"] * 0}, weights))["reshaded"]
    judge.same("erm.reshaded", got, np.zeros_like(got))


@cases(CASES, slow=True)
def test_a_masked_value_influences_nobody(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """Light where the mask is 0 changes no result, not even at its own place.

    All layers of light and keys have one tap here, since wider ones would carry the light to other places. The material stays, since the
    query at its place does read it.
    """
    inputs, weights = case
    wide = {n: t for n, t in weights.items() if n.startswith(("latentEncoder", "KEncoder")) and t.ndim == 4}
    taps = weights | {name: _centre(tensor) for name, tensor in wide.items()}
    closed = _quarter(inputs)
    changed = {**closed, "x4": np.where(closed["mask"][3::8, 3::8, None] == 0, 3 - closed["x4"], closed["x4"])}
    right = judge.right("erm", closed, taps)["reshaded"]
    first, second = yield [ask("erm", i, taps) for i in (closed, changed)]
    judge.holds("erm.reshaded", second["reshaded"], Expected(first["reshaded"], 2 * np.asarray(right.allowed)))


@cases(CASES, slow=True)
def test_equal_light_stays_equal(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """The average of equal values is that value, whatever their weights: if the light is the same everywhere, so is the result."""
    inputs, weights = case
    changed = {n: t * 0 for n, t in weights.items() if n.startswith("latentEncoder") and not n.endswith("4.bias")}
    if not np.any(weights["KEncoder.4.bias"]):
        changed["KEncoder.4.bias"] = weights["KEncoder.4.bias"] + np.float32(1)
    dark = weights | changed
    open_ = {**inputs, "mask": np.ones_like(inputs["mask"])}
    right = judge.right("erm", open_, dark)["reshaded"]
    got = (yield ask("erm", open_, dark))["reshaded"]
    light = judge.round_inputs(dark)["latentEncoder.4.bias"].astype(np.float64)
    faint = (
        np.abs(right.want - light).max(axis=-1, keepdims=True) > np.abs(light).max() / 2
    )  # keys too small for the least sum of weights: the result tends to 0, not to the light
    judge.holds("erm.reshaded", got, Expected(np.where(faint, right.want, light), right.allowed))


@cases(st.tuples(CASES, SEEDS), slow=True)
def test_opposite_materials_share_no_light(judge: Judge, case: tuple[tuple[Inputs, Weights], int]) -> Talk:
    """If keys have the sign of the first normal component, each place averages only the light of its sign: negative weights count as 0.

    Some keys are so long that the sum of their squares leaves float16, though they themselves do not; and all of them count alike.
    """
    (inputs, weights), seed = case
    height, width, _ = inputs["x4"].shape
    signs = np.random.default_rng(seed).choice([-1.0, 1.0, -1 / LONG, 1 / LONG], (height, width))
    signed = {**inputs, "gbuffer": inputs["gbuffer"].copy()}
    signed["gbuffer"][..., 0] = signs.repeat(8, axis=0).repeat(8, axis=1)
    yield from judge.agrees("erm", signed, weights | _sign_of_the_first(weights))


test_the_same_twice = same_twice("erm", cases(CASES, slow=True))


test_sums_round_either_way = rounds_either_way("erm", "reshaded")


test_constants_are_those_of_the_specification = agrees_on_constants("erm")


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("erm")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("erm")


test_a_users_size_agrees_in_windows = agrees_in_windows("erm")


def _centre(weight: np.ndarray) -> np.ndarray:
    """The weights with all taps 0 but the one in the middle."""
    middle = np.zeros_like(weight)
    middle[:, :, 1, 1] = weight[:, :, 1, 1]
    return middle


def _sign_of_the_first(weights: Weights) -> dict[str, np.ndarray]:
    """Weights of a KEncoder whose only key is ``LONG`` times its first input."""
    keys = {name: np.zeros_like(tensor) for name, tensor in weights.items() if name.startswith("KEncoder")}
    for layer, output, source, value in (
        (0, 0, 0, 1),
        (0, 1, 0, -1),
        (2, 0, 0, 1),
        (2, 1, 1, 1),
        (4, 0, 0, LONG),
        (4, 0, 1, -LONG),
    ):
        keys[f"KEncoder.{layer}.weight"][output, source, 1, 1] = value
    return keys


def _quarter(inputs: Inputs) -> Inputs:
    """The inputs with every second pixel at 1/8 size masked."""
    height, width = inputs["mask"].shape
    y, x = np.indices((height, width)) // 8
    return {**inputs, "mask": ((y + x) % 2 == 0).astype(np.float64)}
