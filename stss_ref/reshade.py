# SPDX-License-Identifier: MIT
"""Stage reshade: the colour of warping holes, from samples of their own surface, else in the light of like materials around."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from stss_ref.arrays import Array, Image, Mask, Plane, require
from stss_ref.holes import squared, squared_footprint
from stss_ref.sample import Index, follow

FOOTPRINTS = 2.0
"""Largest distance of a sample from the pixel's static surface; footprints of the pixel. Its square is exact."""
COSINE, STATIC_COSINE = 0.95, 0.5
"""Smallest cosine between the normals of a sample and a pixel that show the same moving object; static geometry."""
REACH = 2
"""Places from a hole to the sides of the square rings at which it looks for like materials."""
STEPS = 1, 2, 4, 8, 16, 32
"""Pixels from place to place of each ring: a hole may be as wide as the motion is long, and colours beside it are mixed."""
LIGHT_REACH = 2
"""Pixels from a hole to the sides of the square of holes whose lights it takes the mean of: each looks at other places."""
NORMAL = 2.0
"""Factor of the squared difference of normals in a weight; that of the difference of base colours is 1."""
DISTANCE = 0.25
"""Factor of the squared distance, in pixels, in a weight on a background, which has neither."""
FLOOR = 2.0**-6
"""Added to base colours: a surface of black base colour reflects, too."""
UNMIXED = 0.25
"""Smallest squared length of the normal of one surface. A shorter one is a mean with a background, and so is its base colour."""


def reshade(
    color: Image,
    warped: Image,
    motion: Image,
    valid: Mask | Array,
    stencil_previous: Plane,
    stencil: Plane,
    normal_previous: Image,
    normal: Image,
    position_previous: Image,
    position: Image,
    base_color: Image,
) -> Image:
    """Fill the warping holes of the earlier frame.

    A static hole ``p`` takes the mean of its own samples: those of the four earlier pixels around ``p + motion(p)`` that show its
    surface (`shows_surface`). A hole that has none, and any of a moving object, finds the light ``l(p)`` for which ``sum w(q) (a(q) l -
    c(q))^2`` is least, ``sum w(q) a(q) c(q) / sum w(q) a(q)^2``, over the pixels ``q = p + s (i, j)`` of its object, of each ``s`` of
    ``STEPS`` and all whole ``i`` and ``j`` with ``max(|i|, |j|) = REACH``, that are no holes, where ``c`` is the warped colour, or
    holes with samples of their own, where ``c`` is their mean. ``a`` is the `brightness` of the base colour ``b``, and
    1 for all ``q`` of a hole that `is_mixed`; ``w(q) = (1 + |b(q) - b(p)|_1 + 2 |n(q) - n(p)|^2)^-4`` with the normal ``n``. A
    background, whose normal is 0, takes from background alone, the nearer the more: ``w(q) = (1 + |b(q) - b(p)|_1 + |q - p|^2 /
    4)^-4``. Then it takes ``a(p)`` times the mean of the lights of the holes within ``LIGHT_REACH`` rows and columns that found one, itself
    among them, with the former weights (`light_sums`). A hole that finds none takes the mean of its own samples, or stays as it is
    warped. Colours below 0 count as 0.

    Source: paper, Reshading (the light of valid neighbours, by how alike the materials are), here at full size; decision 38.

    Args:
        color: (H, W, 3) the earlier frame, finite.
        warped: (H, W, 3) the same, warped by ``motion`` (stage warp).
        motion: (H, W, 2) pixels, current -> earlier; a non-finite motion leads to no sample.
        valid: (H, W) True (or 1) = warped colour to be trusted.
        stencil_previous, stencil: (H, W) object number of the earlier frame and of this one; 0 = static.
        normal_previous, normal: (H, W, 3) world space; finite.
        position_previous, position: (H, W, 3) world position; cm. A non-finite one is near nothing.
        base_color: (H, W, 3) of this frame, finite.

    Returns:
        (H, W, 3), at least 0.

    Raises:
        ArrayError: shapes differ, or an array that must be finite is not.
    """
    require(
        {
            "color": (color, "H, W, 3"), "warped": (warped, "H, W, 3"), "motion": (motion, "H, W, 2"), "valid": (valid, "H, W"),
            "stencil_previous": (stencil_previous, "H, W"), "stencil": (stencil, "H, W"),
            "normal_previous": (normal_previous, "H, W, 3"), "normal": (normal, "H, W, 3"),
            "position_previous": (position_previous, "H, W, 3"), "position": (position, "H, W, 3"),
            "base_color": (base_color, "H, W, 3"),
        },
        non_finite=["motion", "position_previous", "position"], masks=["valid"],
    )  # fmt: skip

    filled = np.maximum(warped, 0)
    y, x = np.nonzero(np.asarray(valid) == 0)
    before, now = (stencil_previous, normal_previous, position_previous), (stencil, normal, position)
    sums, counts = own_samples(np.maximum(color, 0), motion, before, now, y, x)
    has = counts > 0
    filled[y[has], x[has]] = sums[has] / counts[has, None]

    is_source = valid.astype(bool)
    is_source[y[has], x[has]] = True
    # A moving object's samples are known by their normals alone: good enough among others, but not by themselves.
    looks_around = ~has | (stencil[y, x] != 0)
    y, x = y[looks_around], x[looks_around]
    sums, totals = like_sums(filled, is_source, stencil, normal, base_color, y, x)
    has_source = (totals > 0).all(axis=-1)
    y, x = y[has_source], x[has_source]
    light, has_light = np.zeros_like(filled), np.zeros_like(is_source)
    light[y, x], has_light[y, x] = sums[has_source] / totals[has_source], True
    sums, totals = light_sums(light, has_light, stencil, normal, base_color, y, x)
    filled[y, x] = brightness(base_color[y, x], is_mixed(normal[y, x])) * sums / totals
    return filled


def own_samples(
    color: Image,
    motion: Image,
    before: tuple[Plane, Image, Image],
    now: tuple[Plane, Image, Image],
    y: Index,
    x: Index,
) -> tuple[Array, Array]:
    """The sum of the colours of each pixel's own samples, (N, 3), and their number, (N,).

    Args:
        color: (H, W, 3).
        motion: (H, W, 2).
        before, now: stencil (H, W), normal and position (H, W, 3) of the earlier frame and of this one.
        y, x: (N,) the pixels.
    """
    sums, counts = np.zeros((len(y), 3), color.dtype), np.zeros(len(y), color.dtype)
    for there, row, column in four_samples(motion, y, x):
        is_own = there & shows_surface(before, now, (row, column), (y, x))
        sums += np.where(is_own[:, None], color[row, column], 0)
        counts += is_own
    return sums, counts


def four_samples(motion: Image, y: Index, x: Index) -> Iterator[tuple[Mask, Index, Index]]:
    """Row by row the four earlier pixels around the places of N pixels: whether each lies in the frame; its row and column, clamped."""
    height, width, _ = motion.shape
    place = follow(motion)
    finite, left, top = (plane[y, x] for plane in (place.finite, place.x, place.y))
    for j in (0, 1):
        for i in (0, 1):
            row, column = top + j, left + i
            there: Mask = finite & (row >= 0) & (row < height) & (column >= 0) & (column < width)
            yield there, np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)


def shows_surface(
    before: tuple[Plane, Image, Image], now: tuple[Plane, Image, Image], sample: tuple[Index, Index], pixel: tuple[Index, Index]
) -> Mask:
    """(N,) whether samples show the surface that pixels show.

    They do if both show the same object, and both normals are 0, as on a background, or their cosine is at least ``COSINE``. Of static
    geometry ``STATIC_COSINE`` is enough, if the sample's position lies within ``FOOTPRINTS`` of the pixel's.
    """
    (s, n, p), (stencil, normal, position) = [[plane[at] for plane in planes] for planes, at in ((before, sample), (now, pixel))]
    with np.errstate(invalid="ignore", over="ignore"):
        near = squared(p - position) <= FOOTPRINTS**2 * squared_footprint(now[2])[pixel]
    cosine = (normal * n).sum(axis=-1)
    alike = np.where(stencil == 0, near & (cosine >= STATIC_COSINE), cosine >= normal.dtype.type(COSINE))
    return (s == stencil) & ((is_background(n) & is_background(normal)) | alike)


def like_sums(
    color: Image, is_source: Mask, stencil: Plane, normal: Image, base_color: Image, y: Index, x: Index
) -> tuple[Array, Array]:
    """The sums ``w a c`` and ``w a^2`` of the sources around each pixel, (N, 3) both, ring by ring and row by row.

    Args:
        color: (H, W, 3) of the sources.
        is_source, stencil: (H, W).
        normal, base_color: (H, W, 3).
        y, x: (N,) the pixels.
    """
    height, width = stencil.shape
    sums, totals = np.zeros((2, len(y), 3), color.dtype)
    background, mixed = is_background(normal), is_mixed(normal[y, x])
    for there, at in ring_rows((height, width), y, x):
        row, column = at
        counts = there & is_source[at] & (stencil[at] == stencil[y, x]) & (background[at] == background[y, x])
        away = background[y, x] * ((row - y) ** 2 + (column - x) ** 2).astype(color.dtype)
        weights = np.where(counts, likeness(base_color[at], base_color[y, x], normal[at], normal[y, x], away), 0)
        for weight, a, c in zip(weights, brightness(base_color[at], mixed), color[at], strict=True):
            weight_a = weight[:, None] * a
            sums += weight_a * c
            totals += weight_a * a
    return sums, totals


def light_sums(
    light: Image, has_light: Mask, stencil: Plane, normal: Image, base_color: Image, y: Index, x: Index
) -> tuple[Array, Array]:
    """The sums ``w l``, (N, 3), and ``w``, (N, 1), of the lights around each pixel and its own, row by row.

    Those of its object count, and not a mixed one's for another.

    Args:
        light: (H, W, 3).
        has_light, stencil: (H, W).
        normal, base_color: (H, W, 3).
        y, x: (N,) the pixels.
    """
    sums, totals = np.zeros((len(y), 3), light.dtype), np.zeros((len(y), 1), light.dtype)
    background, mixed, none = is_background(normal), is_mixed(normal), np.zeros(len(y), light.dtype)
    for there, at in square_rows(stencil.shape, y, x):
        counts = there & has_light[at]
        for plane in (stencil, background, mixed):
            counts &= plane[at] == plane[y, x]
        weights = np.where(counts, likeness(base_color[at], base_color[y, x], normal[at], normal[y, x], none), 0)
        for weight, one in zip(weights[..., None], light[at], strict=True):
            sums += weight * one
            totals += weight
    return sums, totals


def ring_rows(size: tuple[int, int], y: Index, x: Index) -> Iterator[tuple[Mask, tuple[Index, Index]]]:
    """Row by row the rings around N pixels; as `_places`."""
    for step in STEPS:
        for j in range(-REACH, REACH + 1):
            yield _places(
                size, y + step * j, x + step * np.arange(-REACH, REACH + 1, 1 if abs(j) == REACH else 2 * REACH)[:, None]
            )


def square_rows(size: tuple[int, int], y: Index, x: Index) -> Iterator[tuple[Mask, tuple[Index, Index]]]:
    """Row by row the pixels within ``LIGHT_REACH`` rows and columns of N pixels, themselves among them; as `_places`."""
    for j in range(-LIGHT_REACH, LIGHT_REACH + 1):
        yield _places(size, y + j, x + np.arange(-LIGHT_REACH, LIGHT_REACH + 1)[:, None])


def _places(size: tuple[int, int], row: Index, column: Index) -> tuple[Mask, tuple[Index, Index]]:
    """Whether each of P places in a row lies in the frame, (P, N); row (N,) and column (P, N), clamped."""
    height, width = size
    there: Mask = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return there, (np.clip(row, 0, height - 1), np.clip(column, 0, width - 1))


def likeness(base_color: Array, own_base_color: Array, normal: Array, own_normal: Array, away: Array) -> Array:
    """Weight of materials, base colour and normal (..., N, 3), by how alike those of N pixels, (N, 3), they are; (..., N), in [0, 1].

    ``away`` (..., N): their squared distance in pixels on a background, else 0.
    """
    apart = np.abs(base_color - own_base_color)
    with np.errstate(over="ignore"):
        unlike = 1 + (apart[..., 0] + apart[..., 1] + apart[..., 2]) + NORMAL * squared(normal - own_normal) + DISTANCE * away
        square = unlike * unlike
        return 1 / (square * square)


def brightness(base_color: Array, mixed: Mask) -> Array:
    """The display-referred colours of base colours (..., N, 3) in light 1: ``sqrt(min(max(b, 0), 1) + FLOOR)``.

    A root, as display curves are near one. For those of N holes that are ``mixed`` (N,) it is 1, whatever the base colour.
    """
    return np.where(mixed[:, None], base_color.dtype.type(1), np.sqrt(np.clip(base_color, 0, 1) + base_color.dtype.type(FLOOR)))


def is_mixed(normal: Array) -> Mask:
    """(...) whether a normal (..., 3), and so a base colour, is a mean with a background's, or a background's."""
    return np.asarray(squared(normal) < UNMIXED)


def is_background(normal: Array) -> Mask:
    """(...) where a normal (..., 3) is 0."""
    return np.asarray(~normal.any(axis=-1), bool)
