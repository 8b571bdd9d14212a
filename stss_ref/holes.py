# SPDX-License-Identifier: MIT
"""Stage holes: find the warped pixels that show another surface than the current frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stss_ref.arrays import Array, Image, Mask, Plane, require, require_choice
from stss_ref.constants import HOLE_TESTS, HoleLimits, HoleTest
from stss_ref.sample import Taps, between, bilinear, corners, follow, leads_inside, taps

LEAST_LENGTH = 1e-5
"""Added to a normal's length before division by it (spec 4)."""


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
    ``static: s == 0 and (|q| > 1.5 footprint(p) or turned(0.5))``, or with the paper's test ``s == 0 and d > bias``,
    ``d`` the largest ``|q|`` of the four pixels read, ``bias = 7.5 |NoV| + 45 (1 - |NoV|) + 50 depth``;
    ``moving: s != 0 and turned(0.98)``; ``mesh: 3 |s - stencil| > 1``;
    ``turned(c): normal . n / (|n| + 1e-5) < c``, never where both normals are 0: a surface that was background is turned.

    ``footprint``: see `squared_footprint`; decision 36 says why it replaced the paper's limits, which are Unreal's and for its sizes,
    decision 42 why static surfaces may not turn either.

    Source: spec 4; paper, Preprocessing; ExtraNet.

    Args:
        motion: (H, W, 2) pixels, current -> earlier; non-finite is off screen.
        stencil_previous, stencil: (H, W) object number of the earlier frame and of this one; 0 = static.
        normal_previous, normal: (H, W, 3) world space.
        position_previous, position: (H, W, 3) world position; cm. A non-finite one counts as too far from any other.
        nov: (H, W) dot of normal and view vector; only the paper's test reads it, and depth.
        depth: (H, W) normalised to [0, 1]; likewise.
        test: the test of static surfaces; weights name theirs (`stss_ref.weights.Weights`).
        limits: the constants; None = the specification's.

    Returns:
        valid: (H, W) True where the warped colour is to be trusted, False in a hole.

    Raises:
        ArrayError: shapes differ.
    """
    limits = HoleLimits() if limits is None else limits
    require_choice("test", test, HOLE_TESTS)
    require(
        {
            "motion": (motion, "H, W, 2"), "stencil_previous": (stencil_previous, "H, W"), "stencil": (stencil, "H, W"),
            "normal_previous": (normal_previous, "H, W, 3"), "normal": (normal, "H, W, 3"),
            "position_previous": (position_previous, "H, W, 3"), "position": (position, "H, W, 3"),
            "nov": (nov, "H, W"), "depth": (depth, "H, W"),
        },
        non_finite=["motion", "position_previous", "position", *(("nov", "depth") if test == "footprint" else ())],
    )  # fmt: skip

    place = follow(motion)
    at = taps(place)
    s = bilinear(stencil_previous[..., None], at)[..., 0]
    n = bilinear(normal_previous, at)

    with np.errstate(invalid="ignore", over="ignore"):
        four = offsets(position_previous, position, at)
        # Not d > bias: a distance that is NaN must be a hole too.
        if test == "paper":
            near = largest_distance(four) <= bias(nov, depth, limits)
        else:
            near = squared(between(four, at)) <= limits.footprints**2 * squared_footprint(position)
            near &= ~turned(normal, n, limits.static_cosine)
    static = (s == 0) & ~near
    moving = (s != 0) & turned(normal, n, limits.cosine)
    mesh = objects_apart(s, stencil) > limits.mesh
    return leads_inside(place) & ~static & ~moving & ~mesh


def offsets(position_previous: Image, position: Image, at: Taps) -> list[Image]:
    """The four earlier positions that each pixel reads, minus its own; four times (H, W, 3)."""
    return [there - position for there in corners(position_previous, at)]


def largest_distance(four: Sequence[Image]) -> Plane:
    """(H, W) length of the longest of four offsets; NaN where any of them is."""
    return np.sqrt(squared(np.stack(four))).max(axis=0)


def bias(nov: Plane, depth: Plane, limits: HoleLimits) -> Plane:
    """(H, W) the paper's largest trusted distance."""
    facing = np.abs(nov)
    return limits.facing * facing + limits.grazing * (1 - facing) + limits.depth * depth


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
        return nearer(*neighbours(position, axis=1)) + nearer(*neighbours(position, axis=0))


def neighbours(position: Image, axis: int) -> tuple[Plane, Plane]:
    """(H, W) squared distances to the neighbours before and after each pixel; infinite where there is none, or one is not finite."""
    apart = squared(np.diff(position, axis=axis))
    apart = np.where(apart < np.inf, apart, np.inf)  # NaN too
    before, after = (
        np.pad(apart, [side if i == axis else (0, 0) for i in (0, 1)], constant_values=np.inf) for side in ((1, 0), (0, 1))
    )
    return before, after


def nearer(before: Plane, after: Plane) -> Plane:
    """The smaller of two squared distances; 0 where both are infinite."""
    nearest = np.minimum(before, after)
    return np.where(nearest < np.inf, nearest, 0)


def turned(normal: Image, n: Image, least: float) -> Mask:
    """(H, W) where the cosine is below ``least``, and one of the two normals is not 0."""
    return (cosine(normal, n) < least) & is_surface(normal, n)


def cosine(normal: Image, n: Image) -> Plane:
    """(H, W) of the angle between a normal of length 1 and an earlier one of any length; 0 where that is 0."""
    length = np.sqrt(squared(n))
    return (normal * n).sum(axis=-1) / (length + length.dtype.type(LEAST_LENGTH))


def is_surface(normal: Image, n: Image) -> Mask:
    """(H, W) False where both normals are 0, as on a background."""
    return (n != 0).any(axis=-1) | (normal != 0).any(axis=-1)


def objects_apart(s: Plane, stencil: Plane) -> Plane:
    """(H, W) the difference of the two stencils, summed over the paper's three equal channels."""
    return 3 * np.abs(s - stencil)


def squared(vectors: Array) -> Array:
    """(...) the squared lengths of vectors (..., 3)."""
    squares = vectors * vectors
    return squares[..., 0] + squares[..., 1] + squares[..., 2]
