# SPDX-License-Identifier: MIT
"""Stage holes: which warped pixels show another surface than the one seen now."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stss_ref.arrays import Array, Image, Mask, Plane, require_shape
from stss_ref.constants import HoleLimits, HoleTest
from stss_ref.sample import between, bilinear, follow, leads_inside, taps


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
    test: HoleTest = "footprint",
    limits: HoleLimits | None = None,
) -> Mask:
    """Find the warping holes of one earlier frame.

    ``hole = off screen or static or moving or mesh``, where, with ``s``, ``n`` the earlier stencil and normal and ``q`` the earlier
    world position minus this pixel's, all read at ``p + motion(p)``:
    ``static: s == 0 and |q| > 1.5 footprint(p)``, or with the paper's test ``s == 0 and d > bias``,
    ``d`` the largest ``|q|`` of the four pixels read, ``bias = 7.5 |NoV| + 45 (1 - |NoV|) + 50 depth``;
    ``moving: s != 0 and normal . n / (|n| + 1e-5) < 0.98``, never where both normals are 0;
    ``mesh: 3 |s - stencil| > 1``.

    ``footprint``: see `squared_footprint`; decision 36 says why it replaced the paper's limits, which are Unreal's and for its sizes.

    Source: spec 4; paper, Preprocessing; ExtraNet.

    Args:
        motion: (H, W, 2) pixels, current -> earlier; non-finite is off screen.
        stencil_previous, stencil: (H, W) object number of the earlier frame and of this one; 0 = static.
        normal_previous, normal: (H, W, 3) world space.
        position_previous, position: (H, W, 3) world position; cm. A non-finite one counts as too far from any other.
        nov: (H, W) dot of normal and view vector; the paper's test alone reads it.
        depth: (H, W) normalised to [0, 1]; likewise.
        test: which test of static surfaces.
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

    with np.errstate(invalid="ignore", over="ignore"):
        offsets = [position_previous[j, i] - position for j in (at.y0, at.y1) for i in (at.x0, at.x1)]
        if test == "paper":
            facing = np.abs(nov)
            bias = limits.facing * facing + limits.grazing * (1 - facing) + limits.depth * depth
            near = _largest_distance(offsets) <= bias
        else:
            near = _squared(between(offsets, at)) <= limits.footprints**2 * squared_footprint(position)
    # Not d > bias: a distance that is NaN must be a hole too.
    static = (s == 0) & ~near

    length = np.sqrt((n * n).sum(axis=-1))
    cosine = (normal * n).sum(axis=-1) / (length + length.dtype.type(1e-5))
    surface = (length > 0) | (normal != 0).any(axis=-1)
    moving = (s != 0) & (cosine < limits.cosine) & surface

    mesh = 3 * np.abs(s - stencil) > limits.mesh
    return leads_inside(place) & ~static & ~moving & ~mesh


def squared_footprint(position: Image) -> Plane:
    """The square of each pixel's footprint: of its position's distance to its nearer neighbour in its row, plus that in its column.

    The nearer one, since the farther one may lie beyond a silhouette. Neighbours that are not finite, or outside the frame, do not
    count; where neither does, that term is 0.

    Args:
        position: (H, W, 3).

    Returns:
        (H, W), in the square of their unit.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        return _nearer(position, axis=1) + _nearer(position, axis=0)


def _nearer(position: Image, axis: int) -> Plane:
    """(H, W) squared distance to the nearer of two neighbours."""
    apart = _squared(np.diff(position, axis=axis))
    apart = np.where(apart < np.inf, apart, np.inf)  # NaN too
    before, after = (
        np.pad(apart, [side if i == axis else (0, 0) for i in (0, 1)], constant_values=np.inf) for side in ((1, 0), (0, 1))
    )
    nearest = np.minimum(before, after)
    return np.where(nearest < np.inf, nearest, 0)


def _largest_distance(offsets: Sequence[Image]) -> Plane:
    """(H, W) length of the longest of four; NaN where any of them is."""
    return np.sqrt(_squared(np.stack(offsets))).max(axis=0)


def _squared(vectors: Array) -> Array:
    return (vectors * vectors).sum(axis=-1)
