# SPDX-License-Identifier: MIT
"""Stage holes: each comparison is certainly true, certainly false, or within rounding of its threshold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected, mask
from conformance.answers.port_arithmetic import Arithmetic, Reach, reach
from conformance.answers.warp import interpolate_with_peak, peaks, within_frame
from conformance.protocol.stages import hole_test
from conformance.tolerance import BOUNDS
from stss_ref.arrays import Array
from stss_ref.constants import HoleLimits
from stss_ref.holes import holes, offsets, squared_footprint
from stss_ref.sample import between

Bool = NDArray[np.bool_]
Float64 = NDArray[np.float64]
LIMITS = HoleLimits()
SMALL = 2.0**-62
"""Squares of smaller numbers may be lost in float32."""


@dataclass(frozen=True)
class Maybe:
    """A condition: where it certainly holds, and where it may hold."""

    sure: Bool
    possible: Bool

    def __and__(self, other: Maybe) -> Maybe:
        return Maybe(self.sure & other.sure, self.possible & other.possible)

    def __or__(self, other: Maybe) -> Maybe:
        return Maybe(self.sure | other.sure, self.possible | other.possible)

    def __invert__(self) -> Maybe:
        return Maybe(~self.possible, ~self.sure)


def expect_holes(inputs: dict[str, NDArray[Any]], arithmetic: Arithmetic, off: Float64 | float = 0.0) -> dict[str, Expected]:
    """The mask of the float64 reference; either answer is right where a comparison that decides is within rounding of its threshold.

    Args:
        inputs: of the stage, float64.
        arithmetic: of the port.
        off: (H, W, 2) largest error of the port's motion; pixels.
    """
    test = hole_test(inputs["paper"])
    at = reach(inputs["motion"], arithmetic, off)
    inside, edge = within_frame(at)
    outside = Maybe(~inside & ~edge, ~inside | edge)
    with np.errstate(invalid="ignore", over="ignore"):
        read = interpolate_with_peak(inputs["stencil_previous"][..., None], at, arithmetic)
        s, s_off, peak = (numbers[..., 0] for numbers in read)
        standing = Maybe(peak == 0, np.abs(s) <= s_off)  # certainly where the stencil is 0 at every pixel that counts
        turned = _turns(inputs, at, arithmetic)
        if test == "paper":
            static = standing & _too_far(inputs, at, arithmetic)
        else:
            static = standing & (_beyond_footprint(inputs, at, arithmetic) | turned(LIMITS.static_cosine))
        moving = ~standing & turned(LIMITS.cosine)
        difference = 3 * np.abs(s - inputs["stencil"])
        mesh = _exceeds(difference, 3 * s_off + 4 * arithmetic.unit * difference, LIMITS.mesh)
    hole = outside | static | moving | mesh
    planes = {name: array for name, array in inputs.items() if name != "paper"}
    return {"valid": mask(holes(**planes, test=test, limits=None), hole.possible & ~hole.sure)}


def _exceeds(value: Float64, off: Float64, threshold: Float64 | float) -> Maybe:
    return Maybe(value - off > threshold, ~(value + off <= threshold))


def _beyond_footprint(inputs: dict[str, NDArray[Any]], at: Reach, arithmetic: Arithmetic) -> Maybe:
    """Where the offset that is read exceeds the footprints allowed. Offsets of 0 at all pixels that count give exactly 0."""
    unit, position, previous = arithmetic.unit, inputs["position"], inputs["position_previous"]
    cell = at.cell
    distance = _length(between(offsets(previous, position, cell), cell))
    own, around = peaks(previous, at, position)
    # Within its own four pixels an error of the place moves the value along a slope of at most twice their peak; beyond them, along the
    # slope of the pixels around.
    peak, contrast = np.where(at.unsure[..., None], around, (own, 2 * own))
    wrong = BOUNDS["offset"].roundings * unit * peak + np.minimum(at.slip, 1)[..., None] * contrast
    least = np.where(peak.max(axis=-1) > 0, SMALL, 0)
    off = _length(wrong) + BOUNDS["length"].roundings * unit * distance + least
    off = np.where(np.isnan(off), np.inf, off)  # by a pixel beside them that is not finite
    limit, limit_off, large = reach_of_footprints(position, LIMITS.footprints, unit)
    # Infinite values are holes.
    large |= np.isfinite(distance) & (_length(peak) > 1 / SMALL)
    return Maybe(~(distance - off <= limit + limit_off) & ~large, ~(distance + off <= limit - limit_off) | large)


def reach_of_footprints(position: Array, footprints: float, unit: float) -> tuple[Float64, Float64, Bool]:
    """A multiple of each pixel's footprint, (H, W), its error, and where its square may be infinite in float32.

    A neighbour at an infinite distance does not count.
    """
    limit = footprints * np.sqrt(squared_footprint(position))
    off = BOUNDS["length"].roundings * unit * limit + np.where(limit > 0, SMALL, 0)
    return limit, off, limit > 1 / SMALL


def _too_far(inputs: dict[str, NDArray[Any]], at: Reach, arithmetic: Arithmetic) -> Maybe:
    """Where the largest distance to the four taps exceeds the bias; all four count, even with weight 0."""
    unit = arithmetic.unit
    facing, depth = np.abs(inputs["nov"]), inputs["depth"]
    bias = LIMITS.facing * facing + LIMITS.grazing * (1 - facing) + LIMITS.depth * depth
    size = LIMITS.facing * facing + LIMITS.grazing * np.abs(1 - facing) + LIMITS.depth * np.abs(depth)
    off = BOUNDS["bias"].roundings * unit * (size + LIMITS.grazing * facing)
    cell, previous, position = at.cell, inputs["position_previous"], inputs["position"]
    own = _length(np.stack(offsets(previous, position, cell))).max(axis=0)
    height, width = facing.shape
    around = [
        previous[np.clip(cell.y0 + j, 0, height - 1), np.clip(cell.x0 + i, 0, width - 1)]
        for j in range(-1, 3)
        for i in range(-1, 3)
    ]
    highest = np.where(at.unsure, _length(np.stack(around) - position).max(axis=0), own)
    lowest = np.where(at.unsure, 0, own)
    wrong = BOUNDS["length"].roundings * unit
    # A distance that is NaN is a hole.
    return Maybe(~(lowest * (1 - wrong) <= bias + off), ~(highest * (1 + wrong) <= bias - off))


def _length(vectors: Array) -> Float64:
    return np.sqrt((vectors * vectors).sum(axis=-1, dtype=np.float64))


def _turns(inputs: dict[str, NDArray[Any]], at: Reach, arithmetic: Arithmetic) -> Callable[[float], Maybe]:
    """Where the cosine is below a limit on a surface, that is, where one of the two normals is not 0."""
    unit, normal = arithmetic.unit, inputs["normal"]
    n, n_off, peak = interpolate_with_peak(inputs["normal_previous"], at, arithmetic)
    length = np.sqrt((n * n).sum(axis=-1))
    length_off = np.sqrt((n_off * n_off).sum(axis=-1)) + BOUNDS["length"].roundings * unit * length + SMALL
    dot = (normal * n).sum(axis=-1)
    dot_off = (np.abs(normal) * n_off).sum(axis=-1) + BOUNDS["dot"].roundings * unit * np.abs(normal * n).sum(axis=-1)
    divisor = length + 1e-5
    cosine = dot / divisor
    least = np.maximum(divisor - length_off, 1e-5 * (1 - 4 * unit))
    off = (dot_off + np.abs(cosine) * (length_off + 4 * unit * divisor)) / least + arithmetic.tiny
    size = np.maximum(peak, np.abs(normal)).max(axis=-1)
    sure = (np.maximum(length - length_off, 0) > SMALL) | (np.abs(normal).max(axis=-1) >= arithmetic.tiny)
    return lambda least: _exceeds(-cosine, off, -least) & Maybe(sure, size > 0)
