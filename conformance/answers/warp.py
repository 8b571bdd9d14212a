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
from stss_ref.sample import bilinear, leads_inside, taps

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
    """``image`` (H, W, C) read bilinearly, and the largest error of a port.

    The error is ``u (10 peak) + slip contrast``: the rounding of the lerps, and the errors of fraction and motion, which move the
    result along a slope of at most the contrast of the pixels around.
    """
    own, around = peaks(image, at)
    peak = np.where(at.unsure[..., None], around[0], own)
    with np.errstate(invalid="ignore", over="ignore"):
        allowed = BOUNDS["bilinear"].roundings * (arithmetic.unit * peak + arithmetic.tiny)
        return bilinear(image, taps(at.at)).astype(np.float64), allowed + np.minimum(at.slip, 1)[..., None] * around[1]


def peaks(image: Float64, at: Reach, origin: Float64 | float = 0.0) -> tuple[Float64, tuple[Float64, Float64]]:
    """Largest |value| of the taps that count; largest |value| and contrast of the 4 x 4 pixels around them; all (H, W, C).

    ``origin`` (H, W, C), or one number, is taken off each value.
    """
    cell = taps(at.at)
    # The left and the upper taps always count: a fraction of 1 was below 1 before rounding.
    counts = (cell.fx >= 0, cell.fx > 0, cell.fy > 0, (cell.fx > 0) & (cell.fy > 0))
    places = ((cell.y0, cell.x0), (cell.y0, cell.x1), (cell.y1, cell.x0), (cell.y1, cell.x1))
    own = reduce(np.maximum, (np.where(c[..., None], np.abs(image[p] - origin), 0) for c, p in zip(counts, places, strict=True)))
    # Subtraction rounds in order, so the extremes of the window, less the origin, are those of its differences.
    most, least = (over_windows(extreme, image)[cell.y0, cell.x0] - origin for extreme in (np.maximum, np.minimum))
    return own, (np.maximum(np.abs(most), np.abs(least)), most - least)


def over_windows(extreme: np.ufunc, image: NDArray[Any]) -> NDArray[Any]:
    """``extreme`` of the 4 x 4 pixels from the one before each to the second one after it, as far as the frame goes; both axes."""
    for axis in (0, 1):
        size = image.shape[axis]
        image = reduce(extreme, (image.take(np.clip(np.arange(size) + i, 0, size - 1), axis) for i in range(-1, 3)))
    return image


def within_frame(reached: Reach) -> tuple[Bool, Bool]:
    """Where the place lies in the frame, and where the motion's error may decide whether it does."""
    at = reached.at
    height, width = at.finite.shape
    unsure = np.zeros_like(at.finite)
    for place, off, last in ((at.x + at.fx, reached.off_x, width - 1), (at.y + at.fy, reached.off_y, height - 1)):
        unsure |= (off > 0) & ((np.abs(place) <= off) | (np.abs(place - last) <= off))
    return leads_inside(at), unsure & at.finite
