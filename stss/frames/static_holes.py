# SPDX-License-Identifier: MIT
"""The share of static pixels that count as holes: a large share means that positions or motion are wrong."""

from __future__ import annotations

import numpy as np

from stss.images.color import BLOCK
from stss_ground.cores import for_blocks
from stss_ref.arrays import Image, Mask, Plane


def static_holes(stencil: Plane, normal: Image, valid: Mask) -> float | None:
    """The share of the static surfaces that are holes.

    Args:
        stencil: (H, W), 0 = static.
        normal: (H, W, 3), 0 where nothing was hit.
        valid: (H, W) False in the holes.

    Returns:
        From 0 to 1; None where nothing static is seen.
    """
    height, width = stencil.shape

    def count(rows: slice) -> tuple[int, int]:
        x, y, z = np.moveaxis(normal[rows], -1, 0)  # any() along an axis of three takes five times as long
        static = (stencil[rows] == 0) & ((x != 0) | (y != 0) | (z != 0))
        return int(static.sum()), int((static & ~valid[rows]).sum())

    surfaces, holes = np.sum(for_blocks(height, max(1, BLOCK // width), count), axis=0)
    return float(holes / surfaces) if surfaces else None
