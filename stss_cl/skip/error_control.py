# SPDX-License-Identifier: MIT
"""Everything that decides how much of a frame is computed: whether to look for changes, whether flat tiles may be left out.

Plan, execute, learn: ``ErrorControl.plan`` gives data, ``stss_cl.skip.frame_cache`` executes it, ``learn`` takes what it found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stss_cl.skip.plan import InputPlan, Plan
from stss_cl.skip.uploaded_frames import Tiles


@dataclass(frozen=True)
class Rules:
    """The constants. Periods count frames of a kind.

    Attributes:
        most_changed, most_changed_bounded: where a larger share of the network's inputs changed all of it is computed, since to look
            for the rest would not pay; for ``bounded`` already where flat tiles save more.
        patience, again, rest: after ``patience`` frames in a row, of either kind, in which all was computed, ``rest`` frames are
            computed without looking for changes: looking costs, and a camera that moves seldom stops. From then on ``again`` frames
            in a row suffice: the first of either kind makes up for what was left out meanwhile.
        aim: share of the largest error that leaving out may make of a frame that is checked; the rest is for those between two checks.
        flat: share of the largest error: the largest second difference of a colour that counts as flat.
        first_check, growth, rarest_check: frames without flat tiles between two that are checked: at first; how many times as many
            after each that went well; at most.
        retry: after so many frames of which nothing may be left out it is tried again.
        sampled, block, cut: every so many pixels of a colour are looked at, means of blocks of so many of those compared with the
            last ones: a larger mean difference is another shot, and is checked. Single pixels would take a fast pan over a checker for one.
    """

    most_changed: float = 0.75
    most_changed_bounded: float = 0.4
    patience: int = 8
    again: int = 4
    rest: int = 48
    aim: float = 0.5
    flat: float = 0.5
    first_check: int = 2
    growth: int = 2
    rarest_check: int = 48
    retry: int = 48
    sampled: int = 4
    block: int = 8
    cut: float = 0.08


RULES = Rules()


class Attention:
    """Whether to look where a stream's frames changed; shared by the ``ErrorControl`` of SFs and that of EFs.

    Attributes:
        frames_unlooked: frames left to be computed without looking, this one included.
    """

    def __init__(self) -> None:
        self.frames_unlooked = self._frames_all_changed = 0

    def begin(self) -> bool:
        """The next frame begins; whether to look where it changed."""
        self.frames_unlooked = max(0, self.frames_unlooked - 1)
        return not self.frames_unlooked

    def looked(self, *, all_changed: bool) -> None:
        """Somebody looked in vain, or not."""
        self._frames_all_changed = self._frames_all_changed + 1 if all_changed else 0
        if self._frames_all_changed >= RULES.patience:
            self._frames_all_changed, self.frames_unlooked = RULES.patience - RULES.again, RULES.rest


class ErrorControl:
    """Decides what is computed of each frame of a kind, within the largest error.

    Args:
        max_error: how far an image may be from the one computed whole; 0: every bit counts.
        attention: shared with the other kind.
    """

    def __init__(self, max_error: float, attention: Attention):
        self._max_error, self._attention = max_error, attention
        self._flat, self._shot = FlatControl(max_error), Shot()
        self._stale = False

    @property
    def needs_changes(self) -> bool:
        """Whether it matters where the next frame changed: what was left out of the last one is not mended by changes alone."""
        return not self._attention.frames_unlooked and not self._stale

    def plan_inputs(self, dirty: Tiles | None) -> InputPlan:
        """What of the inputs to compute; ``dirty``: where they may differ from those of the last frame of the kind, None: everywhere."""
        return InputPlan(dirty, looking=not self._attention.frames_unlooked)

    def plan(self, inputs: InputPlan, changed: float, color: NDArray[np.float32] | None) -> Plan:
        """What of the network to run.

        Args:
            inputs: what was computed of them.
            changed: the share of them that then differed.
            color: the newest (H, W, 3), by which another shot is told.
        """
        all_changed = changed > (RULES.most_changed_bounded if self._max_error else RULES.most_changed)
        if not all_changed and not self._stale:
            return Plan("changed", check=False, all_changed=False, looking=inputs.looking)
        may_leave_out = self._max_error > 0 and all_changed and color is not None
        leave_out, check = self._flat.next(cut=self._shot.cut(color)) if may_leave_out and color is not None else (False, False)
        self._stale = leave_out
        return Plan("partly" if leave_out else "whole", check, all_changed, inputs.looking)

    def learn(self, plan: Plan, departure: float | None) -> None:
        """The plan was executed; ``departure``: of a frame that was checked, what leaving out flat tiles would have made of it."""
        if departure is not None:
            self._flat.judge(departure)
        if plan.looking:
            self._attention.looked(all_changed=plan.all_changed)


class FlatControl:
    """Whether flat tiles are left out of the frames of a kind, by the departures of those that are checked.

    Attributes:
        allowed: whether they are, between two checks.
    """

    def __init__(self, max_error: float):
        self._max_error, self.allowed = max_error, False
        self._age, self._period = 0, RULES.first_check

    def next(self, *, cut: bool) -> tuple[bool, bool]:
        """Whether the next frame is computed without its flat tiles, and whether it is checked, which is the other way.

        ``cut``: it begins another shot.
        """
        self._age += 1
        due = cut or self._age >= self._period
        return self.allowed and not due, due

    def judge(self, departure: float) -> None:
        """The frame that was checked would have departed by so much."""
        well, self._age = departure <= RULES.aim * self._max_error, 0
        if not well:
            self._period = RULES.retry
        elif not self.allowed:
            self._period = RULES.first_check
        else:
            self._period = min(RULES.growth * self._period, RULES.rarest_check)
        self.allowed = well


class Shot:
    """Tells another shot from a moving camera, by some of the colours."""

    def __init__(self) -> None:
        self._last: NDArray[np.float32] | None = None

    def cut(self, color: NDArray[np.float32]) -> bool:
        """Whether ``color`` (H, W, 3) shows something else than the last one; the first one does not."""
        now, before = _blocks(color[:: RULES.sampled, :: RULES.sampled]), self._last
        self._last = now
        if before is None:
            return False
        return before.shape != now.shape or float(np.abs(now - before).mean()) > RULES.cut


def _blocks(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    height, width, channels = picture.shape
    rows, columns = max(height // RULES.block, 1), max(width // RULES.block, 1)
    whole = picture[: rows * RULES.block, : columns * RULES.block]
    return whole.reshape(rows, whole.shape[0] // rows, columns, whole.shape[1] // columns, channels).mean(axis=(1, 3))
