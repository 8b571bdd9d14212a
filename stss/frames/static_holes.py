# SPDX-License-Identifier: MIT
"""The share of static pixels that count as holes: a large share means that positions or motion are wrong."""

from __future__ import annotations

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
    static = (stencil == 0) & (normal != 0).any(axis=-1)
    return float((static & ~valid).sum() / static.sum()) if static.any() else None
