# SPDX-License-Identifier: MIT
"""The right answers of each stage: one function for each stage, by its name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from conformance.answers.accumulate import expect_accumulate
from conformance.answers.expected import Expected
from conformance.answers.frame import expect_frame
from conformance.answers.holes import expect_holes
from conformance.answers.motion_chain import expect_motion_chain
from conformance.answers.network import expect_with_weights
from conformance.answers.occlusion_warp import expect_occlusion_warp
from conformance.answers.port_arithmetic import Arithmetic
from conformance.answers.reshade import expect_reshade
from conformance.answers.warp import expect_warp
from conformance.protocol.port import Outputs
from conformance.protocol.stages import STAGES, reference
from stss_ref.weights import Weights

IMAGE_SPACE: dict[str, Callable[[dict[str, NDArray[Any]], Arithmetic], dict[str, Expected]]] = {
    "motion_chain": expect_motion_chain,
    "warp": expect_warp,
    "holes": expect_holes,
    "reshade": lambda inputs, arithmetic: expect_reshade(inputs, arithmetic)[0],
    "rrm": lambda inputs, _: {"valid": Expected(reference("rrm", inputs)["valid"], 0.0)},
    "accumulate": expect_accumulate,
}


def expect(
    stage: str, inputs: dict[str, NDArray[Any]], weights: Weights | None, arithmetic: Arithmetic, got: Outputs
) -> dict[str, Expected]:
    """The right answers for a case.

    Args:
        stage: its name.
        inputs: float64, of numbers that the port's arithmetic holds.
        weights: the port's weights.
        arithmetic: the port's arithmetic.
        got: the port's answer, since the right value of one output may depend on the port's choice in another.

    Returns:
        Output -> right answers; empty if rounding decides on the whole answer, which cannot be judged then.
    """
    if stage in IMAGE_SPACE:
        return IMAGE_SPACE[stage](inputs, arithmetic)
    if stage == "occlusion_warp":
        return expect_occlusion_warp(inputs, arithmetic, got)
    assert STAGES[stage].weights, f"{stage}: no right answers; expected a function in conformance/answers/by_stage.py"
    assert weights is not None
    if stage == "frame":
        return expect_frame(inputs, weights, arithmetic)
    return expect_with_weights(stage, inputs, weights, arithmetic)
