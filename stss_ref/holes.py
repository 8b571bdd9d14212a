# SPDX-License-Identifier: MIT
"""Stage holes: which warped pixels show another surface than the one seen now."""

from __future__ import annotations

import numpy as np

from stss_ref.arrays import Image, Mask, Plane, require_shape
from stss_ref.constants import HoleLimits
from stss_ref.sample import Taps, bilinear, follow, leads_inside, taps


def holes(
    motion: Image,
    stencil_previous: Plane,
    stencil: Plane,
    normal_previous: Image,
    normal: Image,
    position_previous: Image,
    position: Image,
    nov: Plane,
    depth: Plane,
    limits: HoleLimits | None = None,
) -> Mask:
    """Find the warping holes of one earlier frame.

    ``hole = off screen or static or moving or mesh``, where, with ``s``, ``n`` the earlier stencil and normal read at
    ``p + motion(p)`` and ``d`` the largest distance from this pixel's world position to the four read there:
    ``static: s == 0 and d > bias``, ``bias = 7.5 |NoV| + 45 (1 - |NoV|) + 50 depth``;
    ``moving: s != 0 and normal . n / (|n| + 1e-5) < 0.98``, never where both normals are 0;
    ``mesh: 3 |s - stencil| > 1``.

    Source: spec 4; paper, Preprocessing; ExtraNet.

    Args:
        motion: (H, W, 2) pixels, current -> earlier; non-finite is off screen.
        stencil_previous, stencil: (H, W) object number of the earlier frame and of this one; 0 = static.
        normal_previous, normal: (H, W, 3) world space.
        position_previous, position: (H, W, 3) world position; cm. A non-finite one counts as too far from any other.
        nov: (H, W) dot of normal and view vector.
        depth: (H, W) normalised to [0, 1].
        limits: the constants; None = the specification's.

    Returns:
        valid: (H, W) True where the warped colour is to be trusted, False in a hole.

    Raises:
        ArrayError: shapes differ.
    """
    limits = HoleLimits() if limits is None else limits
    height, width, _ = motion.shape
    for name, plane in (("stencil_previous", stencil_previous), ("stencil", stencil), ("nov", nov), ("depth", depth)):
        require_shape(name, plane, (height, width))
    for name, image in (("normal_previous", normal_previous), ("normal", normal)):
        require_shape(name, image, (height, width, 3))
    for name, image in (("position_previous", position_previous), ("position", position)):
        require_shape(name, image, (height, width, 3))

    place = follow(motion)
    at = taps(place)
    s = bilinear(stencil_previous[..., None], at)[..., 0]
    n = bilinear(normal_previous, at)

    facing = np.abs(nov)
    bias = limits.facing * facing + limits.grazing * (1 - facing) + limits.depth * depth
    # Not d > bias: a distance that is NaN must be a hole too.
    static = (s == 0) & ~(_largest_distance(position_previous, position, at) <= bias)

    length = np.sqrt((n * n).sum(axis=-1))
    cosine = (normal * n).sum(axis=-1) / (length + length.dtype.type(1e-5))
    surface = (length > 0) | (normal != 0).any(axis=-1)
    moving = (s != 0) & (cosine < limits.cosine) & surface

    mesh = 3 * np.abs(s - stencil) > limits.mesh
    return leads_inside(place) & ~static & ~moving & ~mesh


def _largest_distance(previous: Image, position: Image, at: Taps) -> Plane:
    """(H, W) largest distance from ``position`` to the four taps of ``previous``, in their unit; NaN where any of the four is."""
    with np.errstate(invalid="ignore", over="ignore"):
        offsets = np.stack([previous[j, i] - position for j in (at.y0, at.y1) for i in (at.x0, at.x1)])
        return np.sqrt((offsets * offsets).sum(axis=-1)).max(axis=0)
