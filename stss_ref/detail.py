# SPDX-License-Identifier: MIT
"""The second colour "detail": differences within a pixel, as warped frames show them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stss_ref.arrays import Array, Image, Plane
from stss_ref.sample import follow, leads_inside, taps

LUMA = (0.299, 0.587, 0.114)
"""Share of R, G and B in a luma (Rec. 601)."""
PLACE = 0.25
"""Distance of the four places of a pixel, the middles of its quarters, from its own place in either axis; pixels."""
OWN = 0.25
"""Weight of the pixel's own first colour at each of its places: that of a sample at the pixel's place."""


def detail(first: Image, stencil: Plane, frames: Sequence[tuple[Image, Image, Plane]]) -> Image:
    """Differences of luma between the four places of a pixel, of all samples that lie within half a pixel of one.

    A sample ``r`` of frame ``i`` weighs ``w = t(dx) t(dy)`` at a place ``s`` of pixel ``p``, with ``(dx, dy) = p + s + motion_i(p) - r``
    and ``t(d) = max(0, 1 - 2 |d|)``. The place's luma is ``(OWN Y(first(p)) + sum w Y(r)) / (OWN + sum w)``; the sums run over the
    samples that show an object of the same number, in the frames into which ``p + motion_i(p)`` leads.

    Source: decision 37. Bilinear reading takes the mean of the samples around a place, so it loses detail; here
    each sample counts at its own place. Holes do not count: beyond a silhouette that moves as the pixel does, samples are right.

    Args:
        first: (H, W, 3) the network's first colour.
        stencil: (H, W) object number.
        frames: of each frame that is warped its colour (H, W, 3), the motion to it (H, W, 2) in pixels, and its stencil.

    Returns:
        (H, W, 3) luma of the right places less the left, half of it; of the lower less the upper, half of it; the mean of the four less
        the first colour's. In [-1, 1] if the colours are in [0, 1].
    """
    own = luma(first)
    sums, totals = np.full((2, 2, *own.shape), OWN * own), np.full((2, 2, *own.shape), OWN, own.dtype)
    for color, motion, numbers in frames:
        place = follow(motion)
        lit, at, inside = luma(color), taps(place), leads_inside(place)
        across, down = tents(at.fx), tents(at.fy)
        for j, y in enumerate((at.y0, at.y1)):
            for i, x in enumerate((at.x0, at.x1)):
                weight = np.where(inside & (numbers[y, x] == stencil), down[j][:, None] * across[i][None], 0)
                totals += weight
                sums += weight * lit[y, x]
    (a, b), (c, d) = sums / totals
    return np.stack([((b - a) + (d - c)) / 2, ((c - a) + (d - b)) / 2, ((a + b) + (c + d)) / 4 - own], axis=-1)


def tents(fraction: Plane) -> tuple[Array, Array]:
    """Weights along one axis at the two places of a pixel, (2, H, W) each: of the tap at or before a place, and of the next one."""
    places = np.stack([fraction - PLACE, fraction + PLACE])
    near, next_ = np.maximum(0, 1 - 2 * np.abs(places)), np.maximum(0, 1 - 2 * np.abs(places - 1))
    return near, next_


def luma(color: Image) -> Plane:
    """(H, W)."""
    r, g, b = LUMA
    return r * color[..., 0] + g * color[..., 1] + b * color[..., 2]
