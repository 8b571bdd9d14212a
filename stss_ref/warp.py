# SPDX-License-Identifier: MIT
"""Stage warp: an earlier frame, moved to the current one."""

from __future__ import annotations

from stss_ref.arrays import Image, Mask, require
from stss_ref.sample import bilinear, follow, leads_inside, taps


def warp(color: Image, motion: Image) -> tuple[Image, Mask]:
    """Read an earlier frame at the place each pixel came from.

    ``warped(p) = bilinear(color, clamp(p + motion(p)))``

    Source: spec 3; paper, Preprocessing.

    Args:
        color: (H, W, C) the earlier frame; any unit, finite.
        motion: (H, W, 2) pixels, current -> earlier, x right, y down; non-finite is off screen and reads ``p`` itself.

    Returns:
        warped: (H, W, C) as ``color``; outside the frame, the nearest border pixel. Holes keep the colour that was read.
        inside: (H, W) True where ``p + motion(p)`` lies in [0, W-1] x [0, H-1].

    Raises:
        ArrayError: shapes differ, or ``color`` is not finite.
    """
    require({"color": (color, "H, W, C"), "motion": (motion, "H, W, 2")}, non_finite=["motion"])

    at = follow(motion)
    return bilinear(color, taps(at)), leads_inside(at)
