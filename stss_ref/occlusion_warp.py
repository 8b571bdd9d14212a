# SPDX-License-Identifier: MIT
"""Stage occlusion_warp: where to look instead for a disoccluded pixel."""

from __future__ import annotations

import numpy as np

from stss_ref.arrays import Array, Image, Mask, Plane, require_finite, require_shape
from stss_ref.sample import bilinear, follow, taps

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
    height, width, channels = color.shape
    require_finite("color", color)
    require_shape("warped", warped, (height, width, channels))
    require_shape("motion", motion, (height, width, 2))
    require_shape("depth", depth, (height, width))
    require_finite("depth", depth)
    require_shape("valid", valid, (height, width))

    lookup = taps(follow(motion))
    occlusion_motion = splat(motion, depth)[lookup.y0, lookup.x0]
    instead = bilinear(color, taps(follow(occlusion_motion)))
    return occlusion_motion, np.where(valid.astype(bool)[..., None], warped, instead)


def splat(motion: Image, depth: Plane) -> Image:
    """Write every pixel's motion to the four earlier pixels around the place it came from; the nearest surface wins.

    Among equal depths the first pixel in raster order wins. The winner is the smallest (depth, raster index), so the order of the
    writes does not matter. Pixels that nothing was written to hold 0.

    Args:
        motion: (H, W, 2) pixels.
        depth: (H, W) normalised, finite.

    Returns:
        (H, W, 2) in the earlier frame's grid.
    """
    height, width = depth.shape
    at = follow(motion)
    writes = at.finite & (depth < FARTHEST)
    # Nearest surface first, raster order among equals (the sort is stable); written in reverse, so that the first is written last.
    order = np.argsort(np.where(writes, depth, np.inf), axis=None, kind="stable")[: writes.sum()][::-1]
    x0 = at.x.ravel()[order, None] + (0, 1, 0, 1)
    y0 = at.y.ravel()[order, None] + (0, 0, 1, 1)
    lands = (x0 >= 0) & (x0 < width) & (y0 >= 0) & (y0 < height)

    earlier = np.zeros_like(motion)
    source = np.broadcast_to(order[:, None], lands.shape)
    # NumPy keeps the last value assigned to a repeated index.
    earlier[y0[lands], x0[lands]] = motion.reshape(-1, 2)[source[lands]]
    return earlier
