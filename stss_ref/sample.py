# SPDX-License-Identifier: MIT
"""The places that motion leads to in a frame, and bilinear reading there: shared by all image-space stages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stss_ref.arrays import Array, Image, Mask, Plane

Index = NDArray[np.intp]


class Place(NamedTuple):
    """Where every pixel's motion leads: whole pixels and a fraction, since their sum would be rounded. All (H, W).

    Attributes:
        x, y: column and row of the pixel at or before the place; not clamped into the frame.
        fx, fy: the fraction from there, to the right and down; [0, 1]. It is 1 only where a number below 1 rounds to 1.
        finite: False where the motion is not finite; the place is then the pixel itself.
    """

    x: Index
    y: Index
    fx: Plane
    fy: Plane
    finite: Mask


class Taps(NamedTuple):
    """The 2 x 2 pixels around each place, clamped into the frame, and the fractions between them in [0, 1]. All (H, W)."""

    x0: Index
    y0: Index
    x1: Index
    y1: Index
    fx: Plane
    fy: Plane


def follow(motion: Image) -> Place:
    """Where every pixel's motion leads: pixels ``p + floor(motion)`` and the fraction ``motion - floor(motion)`` (decision 13).

    The fraction has all the bits of the motion, wherever in the frame it is. A motion with a non-finite component leads to the
    pixel itself, and is off screen (spec 3).

    Args:
        motion: (H, W, 2) pixels, current -> previous.
    """
    height, width, _ = motion.shape
    finite: Mask = np.isfinite(motion[..., 0]) & np.isfinite(motion[..., 1])
    moved = np.where(finite[..., None], motion, 0)
    whole = np.floor(moved)
    fraction = moved - whole
    # One pixel beyond the frame is as good as any distance, and an integer cannot hold a huge one.
    steps = np.clip(whole, (-width - 1, -height - 1), (width + 1, height + 1)).astype(np.intp)
    y, x = np.indices((height, width))
    return Place(x + steps[..., 0], y + steps[..., 1], fraction[..., 0], fraction[..., 1], finite)


def leads_inside(at: Place) -> Mask:
    """(H, W) True where the motion is finite and leads into [0, W-1] x [0, H-1]."""
    height, width = at.finite.shape
    return at.finite & is_within(at.x, at.fx, width) & is_within(at.y, at.fy, height)


def is_within(whole: Index, fraction: Plane, size: int) -> Mask:
    """Where a place lies in [0, size - 1] along one axis."""
    # Not whole + fraction <= size - 1: that sum is rounded.
    return (whole >= 0) & (whole + (fraction > 0) <= size - 1)


def taps(at: Place) -> Taps:
    """The four pixels around each place, the place clamped into the frame first."""
    height, width = at.finite.shape
    x0, y0 = np.clip(at.x, 0, width - 1), np.clip(at.y, 0, height - 1)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    # A clamped place lies on a pixel, and so does one in the last column or row.
    fx = np.where((at.x < 0) | (at.x >= width - 1), 0, at.fx)
    fy = np.where((at.y < 0) | (at.y >= height - 1), 0, at.fy)
    return Taps(x0, y0, x1, y1, fx, fy)


def bilinear(image: Image, at: Taps) -> Image:
    """``image`` (H, W, C) read between four taps.

    A flat image stays flat bit for bit, and whole-pixel motion reads the pixel itself: see `lerp`.
    """
    return between(corners(image, at), at)


def corners(image: Image, at: Taps) -> list[Image]:
    """``image`` (H, W, C) at four taps, row by row."""
    height, width, channels = image.shape
    pixels = image.reshape(height * width, channels)
    return [pixels.take(j * width + i, axis=0) for j in (at.y0, at.y1) for i in (at.x0, at.x1)]


def between(four: Sequence[Image], at: Taps) -> Image:
    """Interpolate between the values (H, W, C) at four taps, row by row."""
    nw, ne, sw, se = four
    fx, fy = at.fx[..., None], at.fy[..., None]
    return lerp(lerp(nw, ne, fx), lerp(sw, se, fx), fy)


def lerp(a: Array, b: Array, t: Array | float) -> Array:
    """``a + (b - a) t`` and not ``a (1 - t) + b t``: between equal numbers it is that number."""
    return a + (b - a) * t
