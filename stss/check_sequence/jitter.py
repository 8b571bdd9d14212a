# SPDX-License-Identifier: MIT
"""Whether the camera is jittered, as for temporal antialiasing: shifted by part of a pixel, by another part in every frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stss.frames.buffers import Buffers
from stss_ref.arrays import Array
from stss_ref.warp import warp

MIN_PIXELS = 200
"""Fewest pixels from which the shift of a pair of frames is taken."""
FLAT = 0.1
"""A surface counts as flat where the position's second difference is below this share of its first."""
COMMON = 0.05
"""A shift is common to the frame when half of the pixels lie this near the median; pixels."""
ALIKE = 0.99
"""Share of the static pixels that must move alike for the camera to count as standing still."""
MIN_JITTER = 0.05
"""Shifts that differ by less than this from frame to frame are no jitter; pixels."""
MAX_JITTER = 1.5
"""A jitter shifts two frames against each other by at most this; pixels."""


@dataclass(frozen=True)
class Jitter:
    """The shifts found in pairs of neighbouring frames.

    Attributes:
        against_motion: shift (x, y) of each pair that positions show and motion does not have; pixels.
        in_motion: shift (x, y) of each pair whose pixels all move alike; pixels.
    """

    against_motion: tuple[tuple[float, float], ...]
    in_motion: tuple[tuple[float, float], ...]

    @property
    def lines(self) -> list[str]:
        """A sentence for each of the two kinds of shift that changes from pair to pair."""
        found: list[str] = []
        if size := _changing(self.against_motion):
            found.append(
                f"jitter: positions are shifted against the motion by up to {size:.2f} pixels, the whole frame alike, and"
                " differently in each frame: the camera is jittered; switch that off, or take it out (docs/profiles.md, Jitter)"
            )
        if size := _changing(self.in_motion):
            found.append(
                f"jitter: all static geometry moves alike, by up to {size:.2f} pixels, differently in each frame: the camera is jittered,"
                " or shakes; a jitter must be switched off, or be taken out (docs/profiles.md, Jitter)"
            )
        return found


def judge_jitter(pairs: Iterable[tuple[Buffers, Buffers]]) -> Jitter:
    """Look at pairs of neighbouring frames (t - 1, t).

    Where only the camera moves, a pixel's world position must equal the one that the frame before has where motion leads to. If a
    whole frame is off by the same part of a pixel, motion lacks the shift of the camera.
    """
    against: list[tuple[float, float]] = []
    within: list[tuple[float, float]] = []
    for before, now in pairs:
        if (shift := _common(_shifts(before, now))) is not None:
            against.append(shift)
        static = (now.stencil == 0) & np.isfinite(now.depth) & np.isfinite(now.motion).all(axis=-1)
        if (shift := _common(now.motion[static].astype(np.float64), share=ALIKE)) is not None:
            within.append(shift)
    return Jitter(tuple(against), tuple(within))


def _changing(shifts: tuple[tuple[float, float], ...]) -> float:
    """The largest shift if the shifts are a jitter's, else 0; pixels."""
    if len(shifts) < 2:
        return 0.0
    array = np.array(shifts)
    spread, size = np.ptp(array, axis=0).max(), np.abs(array).max()
    return float(size) if spread > MIN_JITTER and size < MAX_JITTER else 0.0


def _common(shifts: Array, share: float = 0.5) -> tuple[float, float] | None:
    """The median of shifts (pixels, 2), or None if fewer than ``share`` of them lie near it."""
    if len(shifts) < MIN_PIXELS:
        return None
    median = np.median(shifts, axis=0)
    near = (np.abs(shifts - median).max(axis=-1) < COMMON).mean()
    return (float(median[0]), float(median[1])) if near >= share else None


def _shifts(before: Buffers, now: Buffers) -> Array:
    """(pixels, 2) shift of each pixel of flat static geometry, by least squares along the surface; pixels."""
    here = now.position.astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        usable = (now.stencil == 0) & np.isfinite(now.depth) & np.isfinite(here).all(axis=-1)
        there, inside = warp(np.nan_to_num(before.position.astype(np.float64)), now.motion)
        along = [_slope(here, axis) for axis in (1, 0)]
        flat = usable & inside & along[0][1] & along[1][1]
        x, y, off = along[0][0][flat], along[1][0][flat], (here - there)[flat]
        xx, xy, yy = (x * x).sum(-1), (x * y).sum(-1), (y * y).sum(-1)
        determinant = xx * yy - xy * xy
        bx, by = (x * off).sum(-1), (y * off).sum(-1)
        found = np.stack([yy * bx - xy * by, xx * by - xy * bx], axis=-1) / determinant[:, None]
        left = off - found[:, :1] * x - found[:, 1:] * y
        same = (left * left).sum(-1) < FLAT * np.minimum(xx, yy)  # the same surface, but for a shift along it
    return found[same & np.isfinite(found).all(axis=-1)]


def _slope(position: Array, axis: int) -> tuple[Array, Array]:
    """Change of the position per pixel along an axis, (H, W, 3), and True where the surface is flat along it, (H, W)."""
    later, earlier = np.roll(position, -1, axis), np.roll(position, 1, axis)
    first, second = (later - earlier) / 2, later - 2 * position + earlier
    flat = (second * second).sum(-1) < FLAT**2 * (first * first).sum(-1)
    edge = np.zeros_like(flat)
    edge[(slice(1, -1), slice(1, -1))] = True
    return first, flat & edge
