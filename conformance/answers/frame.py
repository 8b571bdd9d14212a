# SPDX-License-Identifier: MIT
"""Stage ``frame`` up to the network: rounding may change its decisions, and changes its second colour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.holes import expect_holes
from conformance.answers.motion_chain import expect_motion_chain
from conformance.answers.network import Errors, expect_with_weights
from conformance.answers.occlusion_warp import expect_occlusion_warp
from conformance.answers.port_arithmetic import Arithmetic, Reach, reach
from conformance.answers.reshade import expect_reshade
from conformance.answers.warp import over_windows, within_frame
from conformance.protocol.stages import network_inputs
from conformance.tolerance import BOUNDS
from stss_ref.detail import OWN, luma, tents
from stss_ref.frame import is_missing
from stss_ref.weights import Weights

WarpedFrame = tuple[NDArray[Any], Reach, NDArray[Any], NDArray[np.bool_]]
"""A warped colour frame, for detail: its colour (H, W, 3), the places of its motion, its stencil, and (H, W) where it counts."""


def expect_frame(inputs: dict[str, NDArray[Any]], weights: Weights, arithmetic: Arithmetic) -> dict[str, Expected]:
    """The right image; empty if a decision before the network (motion, holes, splat) is within rounding of its threshold.

    Each such decision may change the whole image, so the frame is not judged then.

    Args:
        inputs: of stage ``frame``, float64.
        weights: float32.
        arithmetic: of the port.
    """
    steps = [int(step) for step in inputs["steps"]]
    frames: list[WarpedFrame] = []
    filled: NDArray[Any] | float = 0.0
    for i, step in enumerate(steps):
        if step == 0:
            continue
        chain = expect_motion_chain({"motions": inputs["motions"][:step]}, arithmetic)["motion"]
        motion, allowed = chain.want, np.asarray(chain.allowed)
        off = np.where(allowed > arithmetic.tiny, allowed, 0)
        color, depth = inputs["colors"][i], inputs["gbuffer"][..., 3]
        planes = {
            "stencil_previous": inputs["stencils"][i + 1], "stencil": inputs["stencils"][0],
            "normal_previous": inputs["normals"][i + 1], "normal": inputs["normals"][0],
            "position_previous": inputs["positions"][i + 1], "position": inputs["positions"][0],
            "nov": inputs["nov"], "depth": depth, "paper": np.array([weights.hole_test == "paper"], np.int32),
        }  # fmt: skip
        valid = expect_holes({"motion": motion, **planes}, arithmetic, off)["valid"]
        warping = {"color": color, "warped": color, "motion": motion, "valid": valid.want}
        if chain.undecided or valid.undecided:
            return {}
        if i == 0 and weights.hole_fill == "reshade":
            surfaces = {name: plane for name, plane in planes.items() if name not in ("nov", "depth", "paper")}
            expected, undecided = expect_reshade(
                warping | surfaces | {"base_color": inputs["gbuffer"][..., 6:9]}, arithmetic, off
            )
            if undecided.any():
                return {}
            filled = np.asarray(expected["reshade"].allowed)
        elif i == 0 and expect_occlusion_warp(warping | {"depth": depth}, arithmetic, off=off)["occlusion_motion"].undecided:
            return {}
        at = reach(motion, arithmetic, off)
        inside, unsure = within_frame(at)
        if weights.second_color == "detail" and unsure.any():
            return {}
        frames.append((color, at, planes["stencil_previous"], inside & (not is_missing(steps, i))))
    prepared = network_inputs(inputs, weights)
    first, is_detailed = prepared["color"][..., :3], weights.second_color == "detail"
    errors = detail_errors(first, inputs["stencils"][0], frames, arithmetic) if is_detailed else (0.0, 0.0)
    # The second colour is a difference from the first one's luma, and contains a part of it.
    rounded, moved = (np.broadcast_to(error, first.shape) for error in errors)
    rounded = np.concatenate([0 * first + filled, rounded + (filled if is_detailed else 0)], axis=-1)
    return expect_with_weights("network", prepared, weights, arithmetic, (rounded, np.concatenate([0 * moved, moved], axis=-1)))


def detail_errors(first: NDArray[Any], stencil: NDArray[Any], frames: Sequence[WarpedFrame], arithmetic: Arithmetic) -> Errors:
    """The largest error of a port's second colour ``detail``: docs/conformance.md, Second colour.

    Args:
        first: (H, W, 3) the first colour.
        stencil: (H, W) object number.
        frames: the frames that are warped.
        arithmetic: of the port.
    """
    own = luma(first)
    most, least, peak = own, own, luma(np.abs(first))
    total = np.full((2, 2, *own.shape), OWN)
    change = np.zeros((2, *total.shape))  # errors of the weights: by the port's own rounding, and by that of its motion
    for color, at, numbers, counts in frames:
        cell = at.cell
        light, bright = luma(color), luma(np.abs(color))
        most, least, peak = (
            np.where(counts, extreme(old, over_windows(extreme, image)[cell.y0, cell.x0]), old)
            for extreme, image, old in ((np.maximum, light, most), (np.minimum, light, least), (np.maximum, bright, peak))
        )
        columns, rows = tents(cell.fx), tents(cell.fy)
        for y, row in zip((cell.y0, cell.y1), rows, strict=True):
            for x, column in zip((cell.x0, cell.x1), columns, strict=True):
                total += np.where(counts & (numbers[y, x] == stencil), row[:, None] * column[None], 0)
        across, down = np.add(*columns)[None], np.add(*rows)[:, None]
        place = BOUNDS["quarter"].roundings * arithmetic.unit
        for i, (x, y) in enumerate(((at.rounded_x + place, at.rounded_y + place), (at.off_x, at.off_y))):
            change[i] += np.where(counts, 2 * (x * down + y * across + 2 * x * y), 0)  # 2 is the slope of a tent
    rounded, moved = (np.minimum(change / total, 1) * (most - least)).sum(axis=(1, 2))[..., None] / (2, 2, 4)
    return rounded + (BOUNDS["detail"].roundings * arithmetic.unit * peak[..., None]), moved
