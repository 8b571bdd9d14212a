# SPDX-License-Identifier: MIT
"""Frames in, frames out: the schedule and the history of frames around a backend. Arrays only, no files."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from stss.color import Transfer, transfer
from stss.frames.backends import Backend
from stss.frames.buffers import Buffers
from stss.frames.display_frame import WINDOW, DisplayFrame, prepare
from stss_ground.errors import InputError
from stss_ref.arrays import Image, Mask
from stss_ref.depth import DepthMode
from stss_ref.schedule import FrameKind, Schedule, schedule


@dataclass(frozen=True)
class Output:
    """The output of one display frame.

    Attributes:
        number: the display frame's number.
        kind: SF (rendered) or EF (extrapolated).
        image: (2H, 2W, 3) float32 in the domain the colours came in: scene-linear for ``srgb`` and ``hdr``; finite, >= 0.
        valid: (H, W) False in the warping holes of the newest colour frame; all True for an SF.
    """

    number: int
    kind: FrameKind
    image: Image
    valid: Mask


def plan(window: Sequence[DisplayFrame]) -> Schedule | None:
    """The schedule of the newest frame of ``window``; None for an EF with no rendered frame just before it."""
    newest = window[-1].number
    rendered = {prepared.number for prepared in window if prepared.color is not None}
    return schedule(newest, rendered, reach=newest - window[0].number)


def compute(window: Sequence[DisplayFrame], backend: Backend) -> Output | None:
    """Compute the newest frame of ``window``, display-referred; None for an EF with no rendered frame just before it.

    Args:
        window: up to six consecutive display frames of one size, oldest first.
        backend: the backend to compute it with.
    """
    planned = plan(window)
    if planned is None:
        return None
    image, valid = backend.compute(window, planned.steps)
    return Output(window[-1].number, planned.kind, image, valid)


def decoded(output: Output, curve: Transfer) -> Output:
    """Take an output of `compute` back to the domain that its colours came in."""
    return replace(output, image=curve.decode(output.image))


def supersample(
    frames: Iterable[Buffers], backend: Backend, *, transfer_name: str = "srgb", depth: DepthMode = "scale"
) -> Iterator[Output]:
    """Compute every display frame at twice its size, those that were not rendered too.

    No output waits for a later frame: each comes before the next input is asked for.

    Args:
        frames: display frames in order; ``color`` is None where a frame was not rendered. A number that does not follow the one
            before it, or another size, starts a new history.
        backend: from ``stss.frames.backends.open_backend``.
        transfer_name: ``none``, ``srgb`` or ``hdr`` (spec 9).
        depth: ``clip`` or ``scale`` (spec 0).

    Yields:
        An ``Output`` for every frame, except for an EF with no rendered frame just before it.

    Raises:
        InputError: there is no such transfer.
    """
    curve = transfer(transfer_name)
    window: deque[DisplayFrame] = deque(maxlen=WINDOW)
    for buffers in frames:
        prepared = prepare(buffers, curve, depth)
        if window and (buffers.number != window[-1].number + 1 or buffers.depth.shape != window[-1].nov.shape):
            window.clear()
        window.append(prepared)
        output = compute(tuple(window), backend)
        if output is not None:
            yield decoded(output, curve)


def choose_rendered(numbers: Iterable[int], has_color: frozenset[int], choice: str | None) -> frozenset[int]:
    """Choose the display frames that count as rendered.

    Args:
        numbers: the display frames of a sequence.
        has_color: those that have colour.
        choice: ``even``, ``odd`` or ``all`` frame numbers; None = every frame that has colour, but only the even ones where two
            in a row have it: such a sequence holds the truth of its EF too.

    Raises:
        InputError: a frame chosen as rendered has no colour, or no frame has.
    """
    if not has_color:
        raise InputError("no frame has colour: there is nothing to supersample")
    if choice is None:
        return frozenset(n for n in has_color if n % 2 == 0) if any(n + 1 in has_color for n in has_color) else has_color
    wanted = frozenset(n for n in numbers if choice == "all" or n % 2 == (choice == "odd"))
    if missing := sorted(wanted - has_color):
        raise InputError(f"--rendered {choice}: frame {missing[0]} has no colour ({len(missing)} such frames)")
    return wanted
