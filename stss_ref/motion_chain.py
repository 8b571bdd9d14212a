# SPDX-License-Identifier: MIT
"""Stage motion_chain: motion over several frames, followed from the newest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np

from stss_ref.arrays import Array, Image, Mask, Plane, require, require_choice
from stss_ref.sample import Index, Place, follow, lerp

Gather = Literal["longest", "nearest", "bilinear"]
"""How a motion is read between pixels: see ``GATHERS``. All other stages and the backends take the longest."""


def motion_chain(motions: Image, gather: Gather = "longest") -> Image:
    """Motion from a frame back over as many frames as there are motions.

    ``m_1(p) = motion_t(p)``, ``m_{j+1}(p) = m_j(p) + gather(motion_{t-j}, p + m_j(p))``.

    Source: spec 2.

    Args:
        motions: (k, H, W, 2) motion of frames t, t-1, ..., newest first; pixels, current -> previous, x right, y down.
        gather: how a motion is read between pixels: see ``GATHERS``.

    Returns:
        motion: (H, W, 2) pixels from frame t to frame t-k; non-finite where any motion on the way was.

    Raises:
        ArrayError: ``motions`` is not (k, H, W, 2) with k >= 1.
    """
    *_, last = chain_steps(motions, gather)
    return last


def chain_steps(motions: Image, gather: Gather = "longest") -> Iterator[Image]:
    """``m_1``, ``m_2``, ..., ``m_k`` of ``motion_chain``, one after the other; arguments and errors as there."""
    require({"motions": (motions, "k, H, W, 2")}, non_finite=["motions"])
    require_choice("gather", gather, GATHERS)

    chained = motions[0]
    yield chained
    for earlier in motions[1:]:
        chained = chain_on(chained, earlier, gather)
        yield chained


def chain_on(chained: Image, earlier: Image, gather: Gather = "longest") -> Image:
    """``m_{j+1}`` from ``m_j`` and ``motion_{t-j}``, both (H, W, 2); a chain that is not finite stays so."""
    at = follow(chained)
    return chained + np.where(at.finite[..., None], GATHERS[gather](earlier, at), 0)


def read_motion(motion: Image, x: Index, y: Index) -> Image:
    """``motion`` at whole pixels, 0 outside the frame."""
    height, width, _ = motion.shape
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    pixel = np.clip(y, 0, height - 1) * width + np.clip(x, 0, width - 1)
    return np.where(inside[..., None], motion.reshape(height * width, 2).take(pixel, axis=0), 0)


def truncated(whole: Index, fraction: Plane) -> Index:
    """``trunc`` of a place, 0 between -1 and 0. Farther left or up this returns the floor: outside the frame both read 0."""
    return np.where((whole == -1) & (fraction > 0), 0, whole)


def gather_longest(motion: Image, at: Place) -> Image:
    """The longest of the 2 x 2 motions whose corner is ``trunc(p + m(p))``; 0 when any of the four is 0.

    At a silhouette the faster surface wins, and a still one wins over any. Among equally long motions the first in raster order
    wins. A non-finite motion is longer than any other.
    """
    x, y = truncated(at.x, at.fx), truncated(at.y, at.fy)
    corners = np.stack([read_motion(motion, x + i, y + j) for j in (0, 1) for i in (0, 1)])
    longest = np.take_along_axis(corners, squared_lengths(corners).argmax(axis=0)[None, ..., None], axis=0)[0]
    return np.where(is_any_still(corners)[..., None], 0, longest)


def squared_lengths(corners: Array) -> Array:
    """(4, H, W) of four motions (4, H, W, 2); infinite where one is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = corners[..., 0] * corners[..., 0] + corners[..., 1] * corners[..., 1]
    return np.where(np.isfinite(corners[..., 0]) & np.isfinite(corners[..., 1]), length, np.inf)


def is_any_still(corners: Array) -> Mask:
    """(H, W) True where one of four motions (4, H, W, 2) is 0."""
    return ((corners[..., 0] == 0) & (corners[..., 1] == 0)).any(axis=0)


def gather_nearest(motion: Image, at: Place) -> Image:
    """The motion of the nearest pixel, ``floor(p + m(p) + 1/2)``."""
    return read_motion(motion, at.x + (at.fx >= 0.5), at.y + (at.fy >= 0.5))


def gather_bilinear(motion: Image, at: Place) -> Image:
    """The motion between the four pixels around ``p + m(p)``, with 0 outside the frame."""
    x0, y0, fx, fy = at.x, at.y, at.fx[..., None], at.fy[..., None]
    nw, ne, sw, se = (read_motion(motion, x0 + i, y0 + j) for j in (0, 1) for i in (0, 1))
    with np.errstate(invalid="ignore"):
        return lerp(lerp(nw, ne, fx), lerp(sw, se, fx), fy)


GATHERS: dict[Gather, Callable[[Image, Place], Image]] = {
    "longest": gather_longest,
    "nearest": gather_nearest,
    "bilinear": gather_bilinear,
}
