# SPDX-License-Identifier: MIT
"""Everything that decides how much of a frame is computed: tolerances and their checks, levels and their trials, when to look for changes.

Plan, execute, learn: ``ErrorControl.plan_inputs`` and ``plan`` give data, ``stss_cl.skip.frame_cache`` executes it, ``learn`` takes
what it found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stss_cl.skip.partial_network import Level
from stss_cl.skip.plan import Choice, InputPlan, Outcome, Plan
from stss_cl.skip.uploaded_frames import Tiles


@dataclass(frozen=True)
class Rules:
    """The constants. Shares without another name are shares of the largest error; periods count frames of a kind.

    Attributes:
        most_changed, most_changed_bounded: where a larger share of the network's inputs changed all of it is computed, since to look
            for the rest would not pay; for ``bounded`` already where flat tiles and old features save more.
        patience, again, rest: after ``patience`` frames in a row, of either kind, in which all was computed, ``rest`` frames are
            computed without looking for changes: looking costs, and a camera that moves seldom stops. From then on ``again`` frames
            in a row suffice: the first of either kind makes up for what was left out meanwhile.
        aim: the departure aimed at; the rest is for frames between two checks.
        first_tolerance: safe for most weights, and found out soon where it is not.
        slower, faster: limits of a step of the tolerance, down and up: a departure too large is worse than time lost.
        first_check, growth, rarest_check: frames that left something out between two that are computed both ways: at first; how
            many times as many after each that went well; at most. A check costs a whole frame, one of twelve is 0.08.
        rarest_trial: of levels, at most; the first ones are as above.
        old_aim: the departure up to which features may stay. They depart more the older they are and the faster things move: twice as
            much is too much.
        later: trials so far apart are what shots must last for before a deeper level is tried: a trial costs more than a short shot
            could save.
        level_rest: after so many frames it is tried again whether anything may be left out.
        flat: the largest second difference of a colour that counts as flat: a flat tile lacks at most so much.
        sampled, block, cut: every so many pixels of a colour are looked at, means of blocks of so many of those compared with the
            last ones: a larger mean difference is another shot, of which nothing stays. Single pixels would take a fast pan over a
            checker for one.
    """

    most_changed: float = 0.75
    most_changed_bounded: float = 0.4
    patience: int = 8
    again: int = 4
    rest: int = 48
    aim: float = 0.5
    first_tolerance: float = 0.2
    slower: float = 0.25
    faster: float = 1.25
    first_check: int = 2
    growth: int = 2
    rarest_check: int = 12
    rarest_trial: int = 48
    old_aim: float = 0.25
    later: int = 16
    level_rest: int = 48
    flat: float = 0.5
    sampled: int = 4
    block: int = 8
    cut: float = 0.08


RULES = Rules()


class StreamControl:
    """What the ``ErrorControl`` of SFs and that of EFs share: the tolerance, and whether to look for changes.

    Args:
        max_error: how far an image may be from the one computed whole; 0: every bit counts.

    Attributes:
        tolerance: a value, of the inputs or between two layers, that moved no farther from what was stored stays.
        frames_unlooked: frames left to be computed without looking, this one included.
    """

    def __init__(self, max_error: float):
        self.max_error, self.tolerance = max_error, RULES.first_tolerance * max_error
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

    def kept(self, departure: float) -> bool:
        """The tolerance departed by so much; whether that is within the aim."""
        aim = RULES.aim * self.max_error
        if departure > 0:
            self.tolerance *= min(max(aim / departure, RULES.slower), RULES.faster)
        self.tolerance = min(self.tolerance, self.max_error)
        return departure <= aim


class ErrorControl:
    """Decides what is computed of each frame of a kind, within the largest error.

    Args:
        levels: what may be left out where everything changed, each more than the one before.
        stream: shared with the other kind.
    """

    def __init__(self, levels: Sequence[Level], stream: StreamControl):
        self._levels, self._stream = levels, stream
        self._level, self._shot = LevelControl(len(levels) - 1 if stream.max_error else 0, stream.max_error), Shot()
        self._unchecked, self._period = 0, RULES.first_check
        self._stale = False

    @property
    def needs_changes(self) -> bool:
        """Whether it matters where the next frame changed: what was left out of the last one is not mended by changes alone."""
        return not self._stream.frames_unlooked and not self._stale

    def plan_inputs(self, dirty: Tiles | None, color: NDArray[np.float32] | None) -> InputPlan:
        """What of the inputs to compute.

        Args:
            dirty: where they may differ from those of the last frame of the kind; None: everywhere.
            color: the newest (H, W, 3), by which another shot is told.
        """
        looking = not self._stream.frames_unlooked
        choice = None if looking else self._choose(color)
        older = choice is None or choice.level.history or choice.check is not None
        return InputPlan(dirty, looking, 0.0 if dirty is None else self._stream.tolerance, older, choice)

    def plan(self, inputs: InputPlan, changed: float, color: NDArray[np.float32] | None) -> Plan:
        """What of the network to run.

        Args:
            inputs: what was computed of them.
            changed: the share of them that then differed.
            color: as for ``plan_inputs``.
        """
        most = RULES.most_changed_bounded if self._stream.max_error else RULES.most_changed
        all_changed, recheck = changed > most, inputs.tolerance > 0 and self._is_due()
        choice, network = Choice(self._levels[0], None), "changed"
        if all_changed or self._stale:
            choice = inputs.choice or self._choose(color if all_changed else None)
            self._stale = choice.level != self._levels[0] and choice.check is None
            network = "partly" if self._stale else "whole"
        return Plan(network, inputs.tolerance, choice, recheck, all_changed, inputs.looking)

    def learn(self, plan: Plan, outcome: Outcome) -> None:
        """The plan was executed."""
        if outcome.left_out is not None:
            self._level.judge(outcome.left_out)
        if outcome.kept is not None:
            self._level.fresh()
            self._stale = False
            well = self._stream.kept(outcome.kept)
            self._unchecked = 0
            self._period = min(RULES.growth * self._period, RULES.rarest_check) if well else RULES.first_check
        if plan.looking:
            self._stream.looked(all_changed=plan.all_changed)

    def _choose(self, color: NDArray[np.float32] | None) -> Choice:
        """What to leave out where nearly everything changed; ``color`` None: nothing may be."""
        if not self._stream.max_error or color is None or self._shot.cut(color):
            self._level.fresh()
            return Choice(self._levels[0], None)
        number, due = self._level.next()
        level = self._levels[number]
        if not due:
            return Choice(level, None)
        return Choice(level, "flat tiles" if level.stays == self._levels[0].stays else "both ways")

    def _is_due(self) -> bool:
        """Count a frame of which tolerances may have kept something; whether it is to be computed both ways."""
        self._unchecked += 1
        return self._unchecked >= self._period


class LevelControl:
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
        self._age, self._period = 0, RULES.first_check

    def fresh(self) -> None:
        """The frame was computed whole."""
        self._age = 0

    def next(self) -> tuple[int, bool]:
        """The level of the next frame, and whether it is to be checked."""
        self._age += 1
        if self._trial == 0:
            if self._age >= RULES.level_rest:
                self._deepest, self._trial = self._most, min(1, self._most)
            return 0, False
        # Whether flat tiles may be left out is found out at once; what stays, when it has some age.
        due = self._age >= self._period or self._trial == 1 > self.level
        return self._trial if due else self.level, due

    def judge(self, departure: float) -> None:
        """The frame that was due departed by so much."""
        self._age = 0
        aim = self._max_error * (RULES.aim if self._trial == 1 else RULES.old_aim)
        if departure <= aim:
            self._period = RULES.first_check if self._trial > self.level else min(RULES.growth * self._period, RULES.rarest_trial)
            self.level = self._trial
            if self._period == RULES.rarest_trial:
                self._deepest = self._most  # what was too deep once need not be so for ever
            if self._period >= RULES.later:
                self._trial = min(self.level + 1, self._deepest)
        elif self._trial > self.level:  # was only tried
            self._trial = self._deepest = self.level
        elif departure <= 2 * aim:
            self._period = max(self._period // 2, RULES.first_check)
        else:
            self._trial = self._deepest = self.level = self.level - 1
            self._period = RULES.first_check


class Shot:
    """Tells another shot from a moving camera, by some of the colours."""

    def __init__(self) -> None:
        self._last: NDArray[np.float32] | None = None

    def cut(self, color: NDArray[np.float32]) -> bool:
        """Whether ``color`` (H, W, 3) shows something else than the last one."""
        now, before = _blocks(color[:: RULES.sampled, :: RULES.sampled]), self._last
        self._last = now
        return before is None or before.shape != now.shape or float(np.abs(now - before).mean()) > RULES.cut


def _blocks(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    height, width, channels = picture.shape
    rows, columns = max(height // RULES.block, 1), max(width // RULES.block, 1)
    whole = picture[: rows * RULES.block, : columns * RULES.block]
    return whole.reshape(rows, whole.shape[0] // rows, columns, whole.shape[1] // columns, channels).mean(axis=(1, 3))
