# SPDX-License-Identifier: MIT
"""Decide how much of a frame is computed: whether to look for changes, and whether flat tiles may be left out.

Plan, execute, learn: ``ErrorControl.plan`` returns data, ``stss_cl.skip.frame_cache`` executes it, ``learn`` takes the results.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stss_cl.skip.arrival import Tiles
from stss_cl.skip.plan import InputPlan, Plan


@dataclass(frozen=True)
class Rules:
    """The constants. Periods count frames of one kind, SF or EF.

    Attributes:
        most_changed, most_changed_bounded: if a larger share of the network's inputs changed, the whole network is computed, since
            finding the unchanged rest would not pay. ``bounded`` has a lower share, from which flat tiles save more.
        patience, again, rest: after ``patience`` frames in a row, of either kind, in which all was computed, ``rest`` frames are
            computed without looking for changes: looking costs time, and a moving camera seldom stops. After that, ``again`` frames
            in a row suffice, the first of either kind computed whole to make up for the changes that were not looked for.
        aim: share of ``max_error`` that skipping may cost a frame that is checked; the rest is margin for the frames between checks.
        flat: share of ``max_error`` that the second difference of a colour may have in a flat tile.
        first_check, growth, rarest_check: number of frames without flat tiles between two checks: at first; the factor by which it
            grows after each good check; at most.
        retry: number of frames after a bad check until flat tiles are tried again.
        sampled, block, cut: to tell another shot, every ``sampled``-th pixel of a colour is read, and means of blocks of ``block`` x
            ``block`` of these are compared with the last ones. A mean difference above ``cut`` is another shot, and is checked. By
            single pixels, a fast pan over a checker would look like another shot.
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
    """Decides whether to look where a stream's frames changed; the ``ErrorControl`` of SF and the one of EF share it.

    Attributes:
        frames_unlooked: frames left to be computed without looking, this one included.
    """

    def __init__(self) -> None:
        self.frames_unlooked = self._frames_all_changed = 0

    def begin(self) -> bool:
        """Begin the next frame; returns whether to look where it changed."""
        self.frames_unlooked = max(0, self.frames_unlooked - 1)
        return not self.frames_unlooked

    def looked(self, *, all_changed: bool) -> None:
        """Record a frame whose changes were looked for; ``all_changed``: it was in vain."""
        self._frames_all_changed = self._frames_all_changed + 1 if all_changed else 0
        if self._frames_all_changed >= RULES.patience:
            self._frames_all_changed, self.frames_unlooked = RULES.patience - RULES.again, RULES.rest


class ErrorControl:
    """Decides what is computed of each frame of a kind, within the largest error.

    Args:
        max_error: how far an image may be from the one computed whole; 0: every bit counts.
        attention: shared with the other kind of frame.
    """

    def __init__(self, max_error: float, attention: Attention):
        self._max_error, self._attention = max_error, attention
        self._flat, self._shot = FlatControl(max_error), Shot()
        self._stale = False

    @property
    def needs_changes(self) -> bool:
        """Whether to find where the next frame changed: after a frame without its flat tiles, changes alone do not tell what to compute."""
        return not self._attention.frames_unlooked and not self._stale

    def plan_inputs(self, dirty: Tiles | None) -> InputPlan:
        """Plan which inputs to compute; ``dirty``: where they may differ from those of the last frame of the kind, None: everywhere."""
        return InputPlan(dirty, looking=not self._attention.frames_unlooked)

    def plan(self, inputs: InputPlan, changed: float, color: NDArray[np.float32] | None) -> Plan:
        """Plan which part of the network to run.

        Args:
            inputs: the plan by which the inputs were computed.
            changed: the share of the inputs that then differed.
            color: the newest colour (H, W, 3), by which another shot is told.
        """
        all_changed = changed > (RULES.most_changed_bounded if self._max_error else RULES.most_changed)
        if not all_changed and not self._stale:
            return Plan("changed", check=False, all_changed=False, looking=inputs.looking)
        may_leave_out = self._max_error > 0 and all_changed and color is not None
        leave_out, check = self._flat.next(cut=self._shot.cut(color)) if may_leave_out and color is not None else (False, False)
        self._stale = leave_out
        return Plan("partly" if leave_out else "whole", check, all_changed, inputs.looking)

    def learn(self, plan: Plan, departure: float | None) -> None:
        """Learn from an executed plan; ``departure``: the error that leaving out flat tiles would have made, if the frame was checked."""
        if departure is not None:
            self._flat.judge(departure)
        if plan.looking:
            self._attention.looked(all_changed=plan.all_changed)


class FlatControl:
    """Decides whether flat tiles are left out of the frames of a kind, by the departures of checked frames.

    Attributes:
        allowed: whether they are left out between two checks.
    """

    def __init__(self, max_error: float):
        self._max_error, self.allowed = max_error, False
        self._age, self._period = 0, RULES.first_check

    def next(self, *, cut: bool) -> tuple[bool, bool]:
        """Whether the next frame is computed without its flat tiles, and whether it is checked; never both.

        ``cut``: it begins another shot.
        """
        self._age += 1
        due = cut or self._age >= self._period
        return self.allowed and not due, due

    def judge(self, departure: float) -> None:
        """Record a check: without its flat tiles the frame would have departed by ``departure``."""
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
        """Whether ``color`` (H, W, 3) shows another shot than the last one; False for the first."""
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
