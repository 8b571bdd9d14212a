# SPDX-License-Identifier: MIT
"""Stage occlusion_warp: another place to read for each disoccluded pixel."""

from __future__ import annotations

import numpy as np

from stss_ref.arrays import Array, Image, Mask, Plane, require
from stss_ref.sample import Index, Place, bilinear, follow, taps

FARTHEST = 10.0
"""Normalised depth that the splat's depth buffer starts with: a pixel of this depth or more never splats (spec 5)."""


def occlusion_warp(color: Image, warped: Image, motion: Image, depth: Plane, valid: Mask | Array) -> tuple[Image, Image]:
    """Fill warping holes with the colour found along the motion of the surface that covered them.

    ``occlusion_motion(p) = splat(motion, depth)(clamp(floor(p + motion(p))))``;
    ``occlusion_warp(p) = warped(p)`` where valid, else ``bilinear(color, clamp(p + occlusion_motion(p)))``.

    Source: spec 5; paper, Preprocessing (extrapolation motion vectors).

    Args:
        color: (H, W, C) the earlier frame, finite.
        warped: (H, W, C) the same, warped by ``motion`` (stage warp).
        motion: (H, W, 2) pixels, current -> earlier; a non-finite motion does not splat, and looks up its own pixel.
        depth: (H, W) normalised to [0, 1]; smaller is nearer.
        valid: (H, W) True (or 1) = warped colour to be trusted.

    Returns:
        occlusion_motion: (H, W, 2) pixels, current -> earlier.
        occlusion_warp: (H, W, C).

    Raises:
        ArrayError: shapes differ, or ``color`` or ``depth`` is not finite.
    """
    require(
        {
            "color": (color, "H, W, C"), "warped": (warped, "H, W, C"), "motion": (motion, "H, W, 2"), "depth": (depth, "H, W"),
            "valid": (valid, "H, W"),
        },
        non_finite=["motion"], masks=["valid"],
    )  # fmt: skip

    occlusion_motion = look_up(splat(motion, depth), motion)
    instead = read_along(color, occlusion_motion)
    return occlusion_motion, np.where(valid.astype(bool)[..., None], warped, instead)


def look_up(earlier: Image, motion: Image) -> Image:
    """``earlier`` (H, W, C) at the pixel at or before the place that each motion leads to, clamped into the frame."""
    at = taps(follow(motion))
    return earlier[at.y0, at.x0]


def read_along(color: Image, motion: Image) -> Image:
    """``color`` (H, W, C) between the pixels around the place that each motion leads to."""
    return bilinear(color, taps(follow(motion)))


def splat(motion: Image, depth: Plane) -> Image:
    """Write every pixel's motion to the four earlier pixels around the place it came from; the nearest surface wins.

    Among equal depths the first pixel in raster order wins. The winner is the smallest (depth, raster index), so the order of the
    writes does not matter. Pixels without a write hold 0.

    Args:
        motion: (H, W, 2) pixels.
        depth: (H, W) normalised, finite.

    Returns:
        (H, W, 2) in the earlier frame's grid.
    """
    height, width = depth.shape
    at = follow(motion)
    writes = at.finite & (depth < FARTHEST)
    order = writing_order(depth, writes)
    x, y = written_pixels(at, order)
    lands = (x >= 0) & (x < width) & (y >= 0) & (y < height)

    earlier = np.zeros_like(motion)
    source = np.broadcast_to(order[:, None], lands.shape)
    # NumPy keeps the last value assigned to a repeated index.
    earlier[y[lands], x[lands]] = motion.reshape(-1, 2)[source[lands]]
    return earlier


def writing_order(depth: Plane, writes: Mask) -> Index:
    """(N,) the pixels that write, by raster index: the farthest first, and of equals the last in raster order."""
    # The sort is stable.
    return np.argsort(np.where(writes, depth, np.inf), axis=None, kind="stable")[: writes.sum()][::-1]


def written_pixels(at: Place, order: Index) -> tuple[Index, Index]:
    """Columns and rows, (N, 4) each, of the pixels around the places of ``order``; some outside the frame."""
    return at.x.ravel()[order, None] + (0, 1, 0, 1), at.y.ravel()[order, None] + (0, 0, 1, 1)
