# SPDX-License-Identifier: MIT
"""Positions in a frame and bilinear reading at them: shared by warp, holes and occlusion_warp."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stss_ref.arrays import Image, Mask, Plane

Index = NDArray[np.intp]


class Taps(NamedTuple):
    """The 2 x 2 pixels around a position, and where between them it lies: all (H, W)."""

    x0: Index
    y0: Index
    x1: Index
    y1: Index
    fx: Plane
    fy: Plane


def grid(height: int, width: int, dtype: np.dtype[Any]) -> tuple[Plane, Plane]:
    """Every pixel's own position, ``x`` and ``y``, both (H, W); centres at integers."""
    y, x = np.indices((height, width)).astype(dtype)
    return x, y


def follow(motion: Image) -> tuple[Plane, Plane, Mask]:
    """Where every pixel's motion leads: ``x + dx``, ``y + dy``, and whether that lies within the frame.

    A motion with a non-finite component leads to the pixel itself, and is off screen (spec 3).

    Args:
        motion: (H, W, 2) pixels, current -> previous.

    Returns:
        x, y: (H, W) positions, finite, not clamped.
        inside: (H, W) True where the position lies in [0, W-1] x [0, H-1] and the motion is finite.
    """
    height, width, _ = motion.shape
    finite = np.isfinite(motion).all(axis=-1)
    x, y = grid(height, width, motion.dtype)
    x, y = x + np.where(finite, motion[..., 0], 0), y + np.where(finite, motion[..., 1], 0)
    inside = finite & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return x, y, inside


def taps(x: Plane, y: Plane) -> Taps:
    """The four pixels around each position, the position clamped into the frame first."""
    height, width = x.shape
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    x0, y0 = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    return Taps(x0, y0, x1, y1, x - np.floor(x), y - np.floor(y))


def bilinear(image: Image, at: Taps) -> Image:
    """``image`` (H, W, C) read between four taps.

    ``a + (b - a) t`` and not ``a (1 - t) + b t``: a flat image then stays flat bit for bit, and a whole-pixel position reads the
    pixel itself.
    """
    fx, fy = at.fx[..., None], at.fy[..., None]
    top = image[at.y0, at.x0] + (image[at.y0, at.x1] - image[at.y0, at.x0]) * fx
    bottom = image[at.y1, at.x0] + (image[at.y1, at.x1] - image[at.y1, at.x0]) * fx
    return top + (bottom - top) * fy
