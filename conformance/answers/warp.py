# SPDX-License-Identifier: MIT
"""Stage warp: the right answers of a port, and the largest error of interpolation."""

from __future__ import annotations

from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected, mask
from conformance.answers.port_arithmetic import Arithmetic, Reach, reach
from conformance.tolerance import BOUNDS
from stss_ref.sample import bilinear, corners, leads_inside

Bool = NDArray[np.bool_]
Float64 = NDArray[np.float64]


def expect_warp(inputs: dict[str, NDArray[Any]], arithmetic: Arithmetic) -> dict[str, Expected]:
    """The colour, read bilinearly, and the mask of the places in the frame.

    Args:
        inputs: of the stage, float64.
        arithmetic: of the port.
    """
    at = reach(inputs["motion"], arithmetic)
    want, allowed = interpolate(inputs["color"], at, arithmetic)
    inside, unsure = within_frame(at)
    return {"warped": Expected(want, allowed), "inside": mask(inside, unsure)}


def interpolate(image: Float64, at: Reach, arithmetic: Arithmetic) -> tuple[Float64, Float64]:
    """``image`` (H, W, C) read bilinearly, and the largest error of a port: see `interpolate_with_peak`."""
    return interpolate_with_peak(image, at, arithmetic)[:2]


def interpolate_with_peak(image: Float64, at: Reach, arithmetic: Arithmetic) -> tuple[Float64, Float64, Float64]:
    """``image`` (H, W, C) read bilinearly, the largest error of a port, and the largest |value| that a port may read.

    The error is ``u (10 peak) + slip contrast``: the rounding of the lerps, and the errors of fraction and motion, which move the
    result along a slope of at most the contrast of the pixels around.
    """
    own, around = peaks(image, at)
    peak = np.where(at.unsure[..., None], around[0], own)
    with np.errstate(invalid="ignore", over="ignore"):
        allowed = BOUNDS["bilinear"].roundings * (arithmetic.unit * peak + arithmetic.tiny)
        return bilinear(image, at.cell).astype(np.float64), allowed + np.minimum(at.slip, 1)[..., None] * around[1], peak


def peaks(image: Float64, at: Reach, origin: Float64 | float = 0.0) -> tuple[Float64, tuple[Float64, Float64]]:
    """Largest |value| of the taps that count; largest |value| and contrast of the 4 x 4 pixels around them; all (H, W, C).

    ``origin`` (H, W, C), or one number, is taken off each value.
    """
    cell = at.cell
    # The left and the upper taps always count: a fraction of 1 was below 1 before rounding.
    counts = (cell.fx >= 0, cell.fx > 0, cell.fy > 0, (cell.fx > 0) & (cell.fy > 0))
    taken = corners(image, cell)
    own = reduce(np.maximum, (np.where(c[..., None], np.abs(tap - origin), 0) for c, tap in zip(counts, taken, strict=True)))
    # Subtraction rounds in order, so the extremes of the window, less the origin, are those of its differences.
    most, least = (over_windows(extreme, image)[cell.y0, cell.x0] - origin for extreme in (np.maximum, np.minimum))
    return own, (np.maximum(np.abs(most), np.abs(least)), most - least)


def over_windows(extreme: np.ufunc, image: NDArray[Any]) -> NDArray[Any]:
    """``extreme`` of the 4 x 4 pixels from the one before each to the second one after it, as far as the frame goes; both axes."""
    for axis in (0, 1):
        last = image.shape[axis] - 1
        wide = image.take([0, *range(last + 1), last, last], axis)
        before, after = ((slice(None),) * axis + (cut,) for cut in (slice(None, -1), slice(1, None)))
        wide = extreme(wide[before], wide[after])
        before, after = ((slice(None),) * axis + (cut,) for cut in (slice(None, -2), slice(2, None)))
        image = extreme(wide[before], wide[after])
    return image


def within_frame(reached: Reach) -> tuple[Bool, Bool]:
    """Where the place lies in the frame, and where the motion's error may decide whether it does."""
    at = reached.at
    height, width = at.finite.shape
    unsure = np.zeros_like(at.finite)
    for place, off, last in ((at.x + at.fx, reached.off_x, width - 1), (at.y + at.fy, reached.off_y, height - 1)):
        unsure |= (off > 0) & ((np.abs(place) <= off) | (np.abs(place - last) <= off))
    return leads_inside(at), unsure & at.finite
