# SPDX-License-Identifier: MIT
"""Stage schedule: the earlier frames from which a display frame is made."""

from __future__ import annotations

from collections.abc import Container
from enum import Enum
from typing import NamedTuple


class FrameKind(Enum):
    """SF: rendered, gains resolution only. EF: not rendered, extrapolated from earlier frames."""

    SF = "SF"
    EF = "EF"


STEPS = {FrameKind.SF: (0, 2, 4), FrameKind.EF: (1, 3, 5)}
"""The distances of the three colour frames in display frames back, newest first (paper, Eq. 1)."""


class Schedule(NamedTuple):
    """The plan for one display frame.

    Attributes:
        kind: SF or EF.
        steps: the distance of each of the three colour frames, in display frames back, newest first; 0 to 5. A step equal to the previous
            one stands for a missing frame: the oldest frame found is repeated, with mask 0 (spec 1).
    """

    kind: FrameKind
    steps: tuple[int, int, int]


def schedule(number: int, rendered: Container[int], *, reach: int = 5) -> Schedule | None:
    """Choose the three colour frames of display frame ``number``.

    ``SF: t, t-2, t-4; EF: t-1, t-3, t-5``. No frame after ``t`` is looked up.

    Source: spec 1; paper, Eq. 1.

    Args:
        number: the display frame ``t``, an integer of any sign.
        rendered: the display frames that have colour.
        reach: display frames back over which the chain of motion is unbroken; older frames count as missing.

    Returns:
        The schedule; None for an EF whose previous display frame was not rendered, since no frame can make it.
    """
    kind = FrameKind.SF if number in rendered else FrameKind.EF
    steps: list[int] = []
    for step in STEPS[kind]:
        here = step <= reach and number - step in rendered
        # Past the first gap all frames count as missing: a history has no gap in the middle.
        if here and len(set(steps)) == len(steps):
            steps.append(step)
        elif steps:
            steps.append(steps[-1])
        else:
            return None
    newest, middle, oldest = steps
    return Schedule(kind, (newest, middle, oldest))
