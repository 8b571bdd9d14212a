# SPDX-License-Identifier: MIT
"""FXAA: smooth the edges of one image, by only its luma."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stss_ref.arrays import Array, Image, Mask, Plane, require_shape

Index = NDArray[np.intp]

LUMA = (0.299, 0.587, 0.114)
CONTRAST, DARKEST = 0.125, 0.0312
"""Least contrast of an edge: as a share of the brightest luma around it, and absolute."""
ENDS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 14, 18, 26)
"""Distances along the edge, in pixels, of the search for its end."""
SOFTNESS = 0.75
"""Share of a single pixel's contrast that is removed; 0 to 1."""


def fxaa(image: Image) -> Image:
    """Blend each pixel on an edge with its neighbour across, by a share that the edge's slope gives.

    A pixel is on an edge where the luma of its neighbourhood varies. The edge lies between it and the neighbour across with the
    larger gradient; both ends are looked for along it. With distances ``a <= b`` to the ends, the share ``1/2 - a / (a + b)`` of that
    neighbour is mixed in, if the nearer end is such that the edge crosses the pixel; or, for dots and thin lines, the share by
    the pixel's contrast to all eight neighbours, if that is larger.

    Source: Lottes, FXAA, NVIDIA 2009; the steps and constants of FXAA 3.11, Quality, preset 12, its 1.5 pixels taken as 1.

    Args:
        image: (H, W, 3) display-referred, in [0, 1].

    Returns:
        (H, W, 3) as ``image``; unchanged where there is no edge.

    Raises:
        ArrayError: ``image`` is not (H, W, 3).
    """
    require_shape("image", image, (None, None, 3))
    luma = image @ np.array(LUMA, image.dtype)
    around = _neighbours(luma)
    cross = np.stack([luma, *(around[at] for at in ((-1, 0), (1, 0), (0, -1), (0, 1)))])
    contrast = cross.max(axis=0) - cross.min(axis=0)
    y, x = np.nonzero(contrast >= np.maximum(DARKEST, CONTRAST * cross.max(axis=0)))

    level = _is_level(around)[y, x]
    across = _steeper_side(around, luma, y, x, level)
    edge = _share_by_slope(luma, y, x, across)
    dot = _share_by_contrast(around, luma, contrast)[y, x]
    share = np.maximum(edge, dot)[:, None].astype(image.dtype)

    smooth = image.copy()
    neighbour = image[_clamp(luma, y + across[:, 0], x + across[:, 1])]
    smooth[y, x] += (neighbour - image[y, x]) * share
    return smooth


def _neighbours(luma: Plane) -> dict[tuple[int, int], Plane]:
    """Offset (y, x) -> plane (H, W) of the neighbours there; past the frame's edge, the nearest pixel in it."""
    height, width = luma.shape
    wide = np.pad(luma, 1, mode="edge")
    return {(j, i): wide[1 + j : 1 + j + height, 1 + i : 1 + i + width] for j in (-1, 0, 1) for i in (-1, 0, 1)}


def _is_level(around: dict[tuple[int, int], Plane]) -> Mask:
    """True where the edge runs along a row: second differences down the columns are the larger ones."""

    def bend(before: tuple[int, int], at: tuple[int, int], after: tuple[int, int]) -> Plane:
        return np.abs(around[before] - 2 * around[at] + around[after])

    down = bend((-1, -1), (0, -1), (1, -1)) + 2 * bend((-1, 0), (0, 0), (1, 0)) + bend((-1, 1), (0, 1), (1, 1))
    right = bend((-1, -1), (-1, 0), (-1, 1)) + 2 * bend((0, -1), (0, 0), (0, 1)) + bend((1, -1), (1, 0), (1, 1))
    return down >= right


def _steeper_side(around: dict[tuple[int, int], Plane], luma: Plane, y: Index, x: Index, level: Mask) -> Index:
    """(N, 2) offset (y, x) to the neighbour across the edge, on the side where luma changes more."""
    before = np.where(level, around[-1, 0][y, x], around[0, -1][y, x])
    after = np.where(level, around[1, 0][y, x], around[0, 1][y, x])
    side = np.where(np.abs(before - luma[y, x]) >= np.abs(after - luma[y, x]), -1, 1)
    return np.stack([np.where(level, side, 0), np.where(level, 0, side)], axis=-1)


def _share_by_slope(luma: Plane, y: Index, x: Index, across: Index) -> Array:
    """(N,) share of the neighbour across: 1/2 at the step of a jagged edge, falling to 0 halfway along it."""
    along = np.abs(across[:, ::-1])
    here, there = luma[y, x], luma[_clamp(luma, y + across[:, 0], x + across[:, 1])]
    mean, limit = (here + there) / 2, np.abs(here - there) / 4

    def end(direction: int) -> tuple[Array, Array]:
        """Distance to the edge's end in this direction, and how much the edge's luma there differs from its mean here."""
        distance, off = np.full(len(y), ENDS[-1]), np.zeros_like(here)
        searching = np.ones(len(y), np.bool_)
        for step in ENDS:
            v, u = y + direction * step * along[:, 0], x + direction * step * along[:, 1]
            on = (luma[_clamp(luma, v, u)] + luma[_clamp(luma, v + across[:, 0], u + across[:, 1])]) / 2 - mean
            off = np.where(searching, on, off)
            distance = np.where(searching, step, distance)
            searching &= np.abs(on) < limit
        return distance.astype(luma.dtype), off

    (a, off_a), (b, off_b) = end(-1), end(1)
    off = np.where(a < b, off_a, off_b)
    # An edge that ends towards this pixel's side crosses the pixels of the other side.
    crosses = (off < 0) != (here - mean < 0)
    return np.where(crosses, 0.5 - np.minimum(a, b) / (a + b), 0)


def _share_by_contrast(around: dict[tuple[int, int], Plane], luma: Plane, contrast: Plane) -> Plane:
    """(H, W) share that a pixel loses if it differs from its eight neighbours; 0 inside a straight edge."""
    sides = sum(around[at] for at in ((-1, 0), (1, 0), (0, -1), (0, 1)))
    corners = sum(around[at] for at in ((-1, -1), (-1, 1), (1, -1), (1, 1)))
    unlike = np.abs((2 * sides + corners) / 12 - luma) / np.maximum(contrast, DARKEST)
    unlike = np.clip(unlike, 0, 1)
    return SOFTNESS * ((3 - 2 * unlike) * unlike**2) ** 2


def _clamp(luma: Plane, y: Index, x: Index) -> tuple[Index, Index]:
    return np.clip(y, 0, luma.shape[0] - 1), np.clip(x, 0, luma.shape[1] - 1)
