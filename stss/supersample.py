# SPDX-License-Identifier: MIT
"""Frames in, frames out: the schedule and the history of frames around a backend. Arrays only, no files."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from stss.backends import Backend
from stss.buffers import Buffers
from stss.color import Transfer, transfer
from stss.errors import InputError
from stss_ref.arrays import Array, Image, Mask, Plane
from stss_ref.depth import DepthMode, normalise_depth
from stss_ref.frame import FrameInputs
from stss_ref.schedule import FrameKind, Schedule, schedule

WINDOW = 6
"""An output depends on its own display frame and on the five before it, and on nothing else."""


@dataclass(frozen=True)
class Output:
    """One display frame, done.

    Attributes:
        number: of the display frame.
        kind: SF (rendered) or EF (extrapolated).
        image: (2H, 2W, 3) float32 in the domain the colours came in: scene-linear for ``srgb`` and ``hdr``; finite, >= 0.
        valid: (H, W) False in the warping holes of the newest colour frame; all True for an SF.
    """

    number: int
    kind: FrameKind
    image: Image
    valid: Mask


@dataclass(frozen=True)
class Prepared:
    """A display frame as stage ``frame`` takes it, made once and used by up to six outputs.

    ``color`` (H, W, 3) display-referred or None, ``motion`` (H, W, 2), ``gbuffer`` (H, W, 9), ``nov`` and ``stencil`` (H, W),
    ``position`` (H, W, 3) in cm.
    """

    number: int
    color: Image | None
    motion: Image
    gbuffer: Image
    nov: Plane
    stencil: Plane
    position: Image


def prepare(buffers: Buffers, to_display: Transfer, depth: DepthMode) -> Prepared:
    """Take one frame's colour through the transfer, normalise its depth and stack its G-buffer."""
    planes = [
        buffers.normal,
        normalise_depth(buffers.depth, depth)[..., None],
        buffers.roughness[..., None],
        buffers.metallic[..., None],
        buffers.base_color,
    ]
    return Prepared(
        number=buffers.number,
        color=None if buffers.color is None else to_display.encode(buffers.color),
        motion=buffers.motion,
        gbuffer=np.concatenate(planes, axis=-1),
        nov=buffers.nov,
        stencil=buffers.stencil,
        position=buffers.position,
    )


def plan(window: Sequence[Prepared]) -> Schedule | None:
    """The schedule of the newest frame of ``window``; None where there is nothing to extrapolate it from."""
    newest = window[-1].number
    rendered = {prepared.number for prepared in window if prepared.color is not None}
    return schedule(newest, rendered, reach=newest - window[0].number)


def frame_inputs(window: Sequence[Prepared], steps: tuple[int, int, int]) -> FrameInputs:
    """Stack what stage ``frame`` takes for the newest frame of ``window``.

    Args:
        window: consecutive display frames, oldest first, at least ``max(steps) + 1`` of them.
        steps: how many frames back the three colour frames lie, newest first.

    Returns:
        The inputs, float32.
    """
    back = window[::-1]
    colors = [back[step].color for step in steps]
    shown = (back[0], *(back[step] for step in steps))

    def stack(arrays: list[Array]) -> Array:
        return np.stack(arrays) if arrays else np.empty((0, *back[0].motion.shape), np.float32)

    return FrameInputs(
        colors=stack([color for color in colors if color is not None]),
        steps=steps,
        motions=stack([prepared.motion for prepared in back[: max(steps)]]),
        gbuffer=back[0].gbuffer,
        nov=back[0].nov,
        stencils=stack([prepared.stencil for prepared in shown]),
        normals=stack([prepared.gbuffer[..., :3] for prepared in shown]),
        positions=stack([prepared.position for prepared in shown]),
    )


def compute(window: Sequence[Prepared], backend: Backend, from_display: Transfer) -> Output | None:
    """Compute the newest frame of ``window``; None where there is nothing to extrapolate it from.

    Args:
        window: up to six consecutive display frames of one size, oldest first.
        backend: what computes it.
        from_display: the transfer whose inverse the image is taken through.
    """
    planned = plan(window)
    if planned is None:
        return None
    image, valid = backend.frame(frame_inputs(window, planned.steps))
    return Output(window[-1].number, planned.kind, from_display.decode(image), valid)


def supersample(
    frames: Iterable[Buffers], backend: Backend, *, transfer_name: str = "srgb", depth: DepthMode = "scale"
) -> Iterator[Output]:
    """Twice the size of every frame, and an image for every frame that was not rendered.

    Waits for no future frame: each output comes before the next input is asked for.

    Args:
        frames: display frames in order; ``color`` is None where a frame was not rendered. A number that does not follow the one
            before it, or another size, starts a new history.
        backend: what computes, from ``stss.backends.open_backend``.
        transfer_name: ``none``, ``srgb`` or ``hdr`` (spec 9).
        depth: ``clip`` or ``scale`` (spec 0).

    Yields:
        An ``Output`` for every frame but those extrapolation frames that have no rendered frame just before them.
    """
    curve = transfer(transfer_name)
    window: deque[Prepared] = deque(maxlen=WINDOW)
    for buffers in frames:
        prepared = prepare(buffers, curve, depth)
        if window and (buffers.number != window[-1].number + 1 or buffers.depth.shape != window[-1].nov.shape):
            window.clear()
        window.append(prepared)
        output = compute(tuple(window), backend, curve)
        if output is not None:
            yield output


def choose_rendered(numbers: Iterable[int], has_color: frozenset[int], choice: str | None) -> frozenset[int]:
    """Which display frames count as rendered.

    Args:
        numbers: the display frames there are.
        has_color: those that have colour.
        choice: ``even``, ``odd`` or ``all`` frame numbers; None = every frame that has colour, but only the even ones where two
            in a row have it, for then the sequence holds the truth of its extrapolation frames too.

    Raises:
        InputError: a frame that is to count as rendered has no colour, or none has.
    """
    if not has_color:
        raise InputError("no frame has colour: there is nothing to supersample")
    if choice is None:
        return frozenset(n for n in has_color if n % 2 == 0) if any(n + 1 in has_color for n in has_color) else has_color
    wanted = frozenset(n for n in numbers if choice == "all" or n % 2 == (choice == "odd"))
    if missing := sorted(wanted - has_color):
        raise InputError(f"--rendered {choice}: frame {missing[0]} has no colour ({len(missing)} such frames)")
    return wanted
