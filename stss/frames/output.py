# SPDX-License-Identifier: MIT
"""Frames in, frames out: the schedule and the history of frames around a backend. Arrays only, no files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from stss.frames.backends import Backend
from stss.frames.display_frame import DisplayFrame, schedule_of
from stss.images.color import Transfer
from stss_ground.errors import InputError
from stss_ref.arrays import Image, Mask
from stss_ref.schedule import FrameKind


@dataclass(frozen=True)
class Output:
    """The output of one display frame; its arrays are the caller's.

    Attributes:
        number: the display frame's number.
        kind: SF (rendered) or EF (extrapolated).
        image: (2H, 2W, 3) float32 in the domain the colours came in: scene-linear for ``srgb``; finite, >= 0.
        valid: (H, W) False in the warping holes of the newest colour frame; all True for an SF.
        carried: name -> (2H, 2W, C) float32: the planes of `Buffers.carried`.
    """

    number: int
    kind: FrameKind
    image: Image
    valid: Mask
    carried: Mapping[str, Image] = field(default_factory=dict[str, Image])

    def __repr__(self) -> str:
        """One line, without the numbers of the arrays."""
        return f"Output({self.number}, {self.kind.value}, {self.image.shape[:2]}{''.join(f', {name}' for name in self.carried)})"


def compute(window: Sequence[DisplayFrame], backend: Backend, curve: Transfer) -> Output | None:
    """Compute the newest frame of ``window``; None for an EF with no rendered frame just before it.

    Args:
        window: consecutive display frames of one size, oldest first, as many as the backend takes.
        backend: the backend to compute it with.
        curve: the transfer that their colours went through.
    """
    schedule = schedule_of(window)
    if schedule is None:
        return None
    image, valid = backend.compute(window, schedule.steps)
    step, newest = schedule.steps[0], window[-1]
    color, carried = backend.deliver(image, curve, window[-1 - step].carried, newest.motion if step else None)
    return Output(newest.number, schedule.kind, color, np.array(valid), carried)  # a backend may keep its own for later


def choose_rendered(
    numbers: Sequence[int], has_color: frozenset[int], choice: str | None, cuts: Sequence[int] = ()
) -> frozenset[int]:
    """Choose the display frames that count as rendered.

    Args:
        numbers: the display frames of a sequence, sorted.
        has_color: the frames that have colour.
        choice: ``even``, ``odd`` or ``all`` frame numbers; None = every frame that has colour; where all of them have it, which
            holds the truth of EFs too, the first frame of each shot and every second after it.
        cuts: the first frame of each shot but the first.

    Raises:
        InputError: a frame chosen as rendered has no colour, or no frame has.
    """
    if not has_color:
        raise InputError("no frame has colour: there is nothing to supersample")
    if choice is None:
        if len(numbers) < 2 or not has_color.issuperset(
            numbers
        ):  # pairs at a cut do not count as a sequence that holds its truth
            return has_color
        return frozenset(n for n in numbers if (n - shot_start(n, numbers[0], cuts)) % 2 == 0)
    chosen_numbers = frozenset(n for n in numbers if choice == "all" or n % 2 == (choice == "odd"))
    if missing := sorted(chosen_numbers - has_color):
        raise InputError(f"--rendered {choice}: frame {missing[0]} has no colour ({len(missing)} such frames)")
    return chosen_numbers


def shot_start(number: int, first: int, cuts: Sequence[int]) -> int:
    """The first display frame of the shot that ``number`` belongs to; ``first`` is that of the first shot."""
    return max((cut for cut in cuts if first < cut <= number), default=first)
