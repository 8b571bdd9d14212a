# SPDX-License-Identifier: MIT
"""Stage ``frame``: what comes before the network, whose decisions rounding may turn and whose second colour it moves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.holes import expect_holes
from conformance.answers.motion_chain import expect_motion_chain
from conformance.answers.network import Errors, expect_with_weights
from conformance.answers.occlusion_warp import expect_occlusion_warp
from conformance.answers.port_arithmetic import Arithmetic, Reach, reach
from conformance.answers.warp import over_windows
from conformance.protocol.stages import network_inputs
from conformance.tolerance import BOUNDS
from stss_ref.constants import HoleTest
from stss_ref.detail import OWN, luma, tents
from stss_ref.frame import is_missing
from stss_ref.sample import taps
from stss_ref.weights import Weights

Inputs = dict[str, NDArray[Any]]


class Seen(NamedTuple):
    """A colour frame that is warped: its colour (H, W, 3), where its motion leads, where to trust it, decisions that rounding may turn."""

    color: NDArray[Any]
    at: Reach
    valid: NDArray[np.bool_]
    undecided: int


def expect_frame(inputs: Inputs, weights: Weights, arithmetic: Arithmetic) -> dict[str, Expected]:
    """The right image; empty if a decision before the network (motion, holes, splat) is within rounding of its threshold.

    Each may change the whole image, so a frame that has one is not judged.

    Args:
        inputs: of stage ``frame``, float64.
        weights: float32.
        arithmetic: of the port.
    """
    seen: list[Seen] = []
    for each in _look_back(inputs, weights.hole_test, arithmetic):
        if each.undecided:
            return {}
        seen.append(each)
    made = network_inputs(inputs, weights)
    errors = None if weights.second_color == "newest" else detail_errors(made["color"][..., :3], seen, arithmetic)
    return expect_with_weights("network", made, weights, arithmetic, errors)


def _look_back(inputs: Inputs, test: HoleTest, arithmetic: Arithmetic) -> Iterator[Seen]:
    """The colour frames that are warped, newest first."""
    steps = [int(step) for step in inputs["steps"]]
    for i, step in enumerate(steps):
        if step == 0:
            continue
        chain = expect_motion_chain({"motions": inputs["motions"][:step]}, arithmetic)["motion"]
        motion, allowed = chain.want, np.asarray(chain.allowed)
        off = np.where(allowed > arithmetic.tiny, allowed, 0)
        planes = {
            "stencil_previous": inputs["stencils"][i + 1], "stencil": inputs["stencils"][0],
            "normal_previous": inputs["normals"][i + 1], "normal": inputs["normals"][0],
            "position_previous": inputs["positions"][i + 1], "position": inputs["positions"][0],
            "nov": inputs["nov"], "depth": inputs["gbuffer"][..., 3], "paper": np.array([test == "paper"], np.int32),
        }  # fmt: skip
        valid = expect_holes({"motion": motion, **planes}, arithmetic, off)["valid"]
        undecided, color = chain.undecided + valid.undecided, inputs["colors"][i]
        if i == 0:
            given = {"color": color, "warped": color, "motion": motion, "depth": inputs["gbuffer"][..., 3], "valid": valid.want}
            undecided += expect_occlusion_warp(given, arithmetic, off=off)["occlusion_motion"].undecided
        trusted = valid.want.astype(bool) & (not is_missing(steps, i))
        yield Seen(color, reach(motion, arithmetic, off), trusted, undecided)


def detail_errors(first: NDArray[Any], seen: Sequence[Seen], arithmetic: Arithmetic) -> Errors:
    """The most by which a port's second colour ``detail`` is off: docs/conformance.md, Second colour.

    Args:
        first: (H, W, 3) the first colour.
        seen: the frames that are warped.
        arithmetic: of the port.
    """
    own = luma(first)
    most, least, peak = own, own, luma(np.abs(first))
    total = np.full((2, 2, *own.shape), OWN)
    change = np.zeros((2, *total.shape))  # of the weights: by the port's own rounding, and by that of its motion
    for color, at, valid, _ in seen:
        cell = taps(at.at)
        light, bright = luma(color), luma(np.abs(color))
        most, least, peak = (
            np.where(valid, extreme(old, over_windows(extreme, image)[cell.y0, cell.x0]), old)
            for extreme, image, old in ((np.maximum, light, most), (np.minimum, light, least), (np.maximum, bright, peak))
        )
        across, down = np.add(*tents(cell.fx))[None], np.add(*tents(cell.fy))[:, None]
        total += np.where(valid, down * across, 0)
        place = BOUNDS["quarter"].roundings * arithmetic.unit
        for i, (x, y) in enumerate(((at.rounded_x + place, at.rounded_y + place), (at.off_x, at.off_y))):
            change[i] += np.where(valid, 2 * (x * down + y * across + 2 * x * y), 0)  # 2 is the slope of a tent
    rounded, moved = (np.minimum(change / total, 1) * (most - least)).sum(axis=(1, 2))[..., None] / (2, 2, 4)
    return Errors(rounded + BOUNDS["detail"].roundings * arithmetic.unit * peak[..., None], moved)
