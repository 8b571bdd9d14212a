# SPDX-License-Identifier: MIT
"""Whether the camera is jittered, as for temporal antialiasing: shifted by part of a pixel, by another part in every frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stss_ref.arrays import Array

MIN_PIXELS = 200
"""Fewest pixels from which the shift of a pair of frames is taken."""
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

    Where only the camera moves, motion must lead to the place at which the previous frame shows a pixel's position. If a whole frame
    is off by the same part of a pixel, motion lacks the shift of the camera.

    Attributes:
        against_motion: shift (x, y) of each pair that is in positions and not in motion; pixels.
        in_motion: shift (x, y) of each pair whose pixels all move alike; pixels.
    """

    against_motion: tuple[tuple[float, float], ...]
    in_motion: tuple[tuple[float, float], ...]

    @property
    def lines(self) -> list[str]:
        """A sentence for each of the two kinds of shift that changes from pair to pair."""
        lines: list[str] = []
        if size := _changing(self.against_motion):
            lines.append(
                f"jitter: positions are shifted against the motion by up to {size:.2f} pixels, the whole frame alike, and"
                " differently in each frame: the camera is jittered; switch that off, or take it out (docs/profiles.md, Jitter)"
            )
        if size := _changing(self.in_motion):
            lines.append(
                f"jitter: all static geometry moves alike, by up to {size:.2f} pixels, differently in each frame: the camera is jittered,"
                " or shakes; a jitter must be switched off, or be taken out (docs/profiles.md, Jitter)"
            )
        return lines


def _changing(shifts: tuple[tuple[float, float], ...]) -> float:
    """The largest shift if the shifts are a jitter's, else 0; pixels."""
    if len(shifts) < 2:
        return 0.0
    array = np.array(shifts)
    spread, size = np.ptp(array, axis=0).max(), np.abs(array).max()
    return float(size) if spread > MIN_JITTER and size < MAX_JITTER else 0.0


def common_shift(shifts: Array, share: float = 0.5) -> tuple[float, float] | None:
    """The median of shifts (pixels, 2), or None if fewer than ``share`` of them lie near it."""
    if len(shifts) < MIN_PIXELS:
        return None
    median = np.median(shifts, axis=0)
    near = (np.abs(shifts - median).max(axis=-1) < COMMON).mean()
    return (float(median[0]), float(median[1])) if near >= share else None
