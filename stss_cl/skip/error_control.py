# SPDX-License-Identifier: MIT
"""What of the network is computed where everything changes: flat tiles need no residual, and deep features change slowly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FIRST, GROWTH, LONGEST = 2, 2, 48
"""Frames of a kind between two that are computed whole: at first; so many times as many after each that departed little; at most."""
AIM, OLD_AIM = 0.5, 0.25
"""The departure up to which more is left out, as a share of the largest error; the rest is for what the tolerance does. Of features
that stay, which depart more the older they are and the faster things move, half as much; twice as much is too much."""
LATER = 16
"""Frames of a kind between two checks from which on it is tried to leave more: a trial costs more than a short shot could save."""
REST = 48
"""After so many frames it is tried again whether the deep layers may stay."""
SAMPLED, BLOCK, CUT = 4, 8, 0.08
"""Every so many pixels of a colour are looked at, means of blocks of so many of those compared with the last ones: a larger mean
difference is another shot, of which nothing stays. (Single pixels would take a fast pan over a checker for one.)"""


class Depth:
    """Chooses the level of each frame of a kind, by the departures of those that are checked.

    Args:
        deepest: the last level.
        max_error: how far an image may be from the one computed whole.

    Attributes:
        level: of frames between two checks.
    """

    def __init__(self, deepest: int, max_error: float):
        self._most, self._max_error = deepest, max_error
        self.level = 0
        self._deepest, self._trial = deepest, min(1, deepest)
        self._age, self._period = 0, FIRST

    def fresh(self) -> None:
        """The frame was computed whole."""
        self._age = 0

    def next(self) -> tuple[int, bool]:
        """The level of the next frame, and whether it is to be checked."""
        self._age += 1
        if self._trial == 0:
            if self._age >= REST:
                self._deepest, self._trial = self._most, min(1, self._most)
            return 0, False
        # Whether flat tiles may be left out is found out at once; what stays, when it has some age.
        due = self._age >= self._period or self._trial == 1 > self.level
        return self._trial if due else self.level, due

    def judge(self, departure: float) -> None:
        """The frame that was due departed by so much."""
        self._age = 0
        aim = self._max_error * (AIM if self._trial == 1 else OLD_AIM)
        if departure <= aim:
            self._period = FIRST if self._trial > self.level else min(GROWTH * self._period, LONGEST)
            self.level = self._trial
            if self._period == LONGEST:
                self._deepest = self._most  # what was too deep once need not be so for ever
            if self._period >= LATER:
                self._trial = min(self.level + 1, self._deepest)
        elif self._trial > self.level:  # was only tried
            self._trial = self._deepest = self.level
        elif departure <= 2 * aim:
            self._period = max(self._period // 2, FIRST)
        else:
            self._trial = self._deepest = self.level = self.level - 1
            self._period = FIRST


class Shot:
    """Tells another shot from a moving camera, by some of the colours."""

    def __init__(self) -> None:
        self._last: NDArray[np.float32] | None = None

    def cut(self, color: NDArray[np.float32]) -> bool:
        """Whether ``color`` (H, W, 3) shows something else than the last one."""
        now, before = _blocks(color[::SAMPLED, ::SAMPLED]), self._last
        self._last = now
        return before is None or before.shape != now.shape or float(np.abs(now - before).mean()) > CUT


def _blocks(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    height, width, channels = picture.shape
    rows, columns = max(height // BLOCK, 1), max(width // BLOCK, 1)
    whole = picture[: rows * BLOCK, : columns * BLOCK]
    return whole.reshape(rows, whole.shape[0] // rows, columns, whole.shape[1] // columns, channels).mean(axis=(1, 3))
