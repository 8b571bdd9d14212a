# SPDX-License-Identifier: MIT
"""Whether the background's motion is that of the camera's turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from stss.check_sequence.value_statistics import Line
from stss.frames.buffers import Buffers
from stss.sequence.background import background_motion
from stss.sequence.projection import Projection

OFF = 0.25
"""Pixels: the largest median error of the background's motion without a warning."""
MIN_PIXELS = 200
"""Fewest pixels of background that allow a judgement."""


@dataclass(frozen=True)
class BackgroundVerdict:
    """Facts about the background's motion, from the camera's turn.

    Attributes:
        share: of the frame.
        turns: median motion that the camera gives it; pixels.
        error: median distance of the stored motion from that; pixels. Infinite: most of it is not finite.
        largest: largest component of the stored motion; pixels.
    """

    share: float
    turns: float
    error: float
    largest: float

    def lines(self) -> list[Line]:
        """Findings."""
        if self.error <= OFF:
            return [("note", f"background: its motion is right to {self.error:.2g} pixels, by the camera that positions show")]
        error = "0" if self.largest == 0 else "not finite" if self.error == np.inf else f"off by {self.error:.2g} pixels"
        return [
            (
                "warning",
                f"background: its motion is {error}, though the camera turns by {self.turns:.2g} pixels a frame: EFs lose up to 5 dB. "
                "Write the motion of infinitely far points, which depends only on the rotation, or give --background camera",
            )
        ]


def measure_background(before: Projection, current: Projection, now: Buffers) -> list[BackgroundVerdict]:
    """The facts of one frame, by its projection and that of the frame before; none where too little background is seen."""
    background = ~np.isfinite(now.depth)
    motion = background_motion(before, current, np.argwhere(background)[:, ::-1])
    is_seen = np.isfinite(motion).all(axis=-1)
    if is_seen.sum() < MIN_PIXELS:
        return []
    right, own = motion[is_seen], now.motion[background][is_seen].astype(np.float64)
    own = np.where(np.isfinite(own), own, np.inf)
    with np.errstate(invalid="ignore"):
        errors = np.linalg.norm(own - right, axis=-1)
    turns = float(np.median(np.linalg.norm(right, axis=-1)))
    return [BackgroundVerdict(is_seen.sum() / background.size, turns, float(np.median(errors)), float(np.abs(own).max()))]


def common_verdict(frames: Sequence[BackgroundVerdict]) -> BackgroundVerdict | None:
    """The median of each fact over the frames; None without any."""
    return BackgroundVerdict(*map(float, np.median([astuple(frame) for frame in frames], axis=0))) if frames else None
