# SPDX-License-Identifier: MIT
"""Upload display frames to the device, each once, and find where each differs from the one before it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from stss_cl.device.buffers import Plain
from stss_cl.device.discovery import Device
from stss_cl.image_space.frame_planes import Sources
from stss_cl.skip.arrival import Arrival, Tiles
from stss_cl.skip.display_frame import DisplayFrame
from stss_cl.skip.planes import Planes
from stss_ref.arrays import require_finite

MOST_FRAMES = 9
"""Number of remembered display frames: an output's window, the window of the previous output of the same kind, and one more. For frames
older than the window only their changes are remembered, since the caller may reuse their arrays."""


@dataclass
class UploadedFrame:
    """A display frame on the device.

    Attributes:
        frame: the caller's object; None once it is older than the window.
        number: counts the frames in order of arrival; only for comparisons.
        planes: the buffers by name; empty once it is older than the window.
        color: its colour, if it has one; None once it is older than the window.
        changed: where it differs from the previous frame, or moves; None: there is no previous frame, or they were not compared.
        recolored: where its colour differs from the previous colour, nowhere if it has no colour; None: likewise.
    """

    frame: DisplayFrame | None
    number: int
    planes: dict[str, cl.Buffer]
    color: cl.Buffer | None
    changed: Tiles | None = None
    recolored: Tiles | None = None

    def let_go(self) -> None:
        """Drop its arrays: the caller may write to them again. Call ``Planes.dropped`` afterwards."""
        self.frame, self.planes, self.color = None, {}, None


class UploadedFrames:
    """The last display frames of one size (height, width), in a row."""

    def __init__(self, device: Device, height: int, width: int):
        self._device, self.size = device, (height, width)
        self._arrival = Arrival(device, height, width)
        self._shape = -(-height // 4), -(-width // 4)
        self._planes = Planes(device)
        self._chain: deque[UploadedFrame] = deque()
        self._count = 0

    def load(self) -> None:
        """Let the runtime load or compile the kernel that compares frames."""
        self._arrival.load()

    def take(self, window: Sequence[DisplayFrame], *, compare: bool) -> list[UploadedFrame]:
        """Upload the frames of ``window``, consecutive and oldest first; frames of the last window are not uploaded or compared again.

        Frames are compared when they are uploaded, and only with frames of the same window: the caller may have written to older arrays.

        Args:
            window: its last frame is the one to compute.
            compare: whether to find where new frames differ from those before them.

        Raises:
            ArrayError: a shape or dtype does not fit, or a value that must be finite is not.
        """
        first = next((i for i, each in enumerate(self._chain) if each.frame is window[0]), len(self._chain))
        uploads = list(self._chain)[first : first + len(window)]
        if not uploads or any(each.frame is not frame for each, frame in zip(uploads, window, strict=False)):
            self.forget()
            uploads = []
        for frame in window[len(uploads) :]:
            self._arrive(frame, uploads, compare=compare)
            uploads.append(self._chain[-1])
        self._planes.arrived()
        if self._chain[-1] is not uploads[-1]:
            while self._chain[-1] is not uploads[-1]:
                self._drop(self._chain.pop())
            self._count += 1  # the next frame does not follow the last one
        self._drop(*takewhile(lambda each: each is not uploads[0], self._chain))
        return uploads

    def find_motion(self, motion: Plain) -> cl.Buffer | None:
        """The buffer of a motion that a frame of the last window holds; None: there is none."""
        return next(
            (each.planes["motion"] for each in self._chain if each.frame is not None and each.frame.motion is motion), None
        )

    def require_finite(self) -> None:
        """Wait for the checks for which ``take`` did not wait: all frames of the last window must be finite.

        Raises:
            ArrayError: one was not. All frames are forgotten.
        """
        if bad := self._arrival.not_finite():
            self._refuse(bad)

    def _refuse(self, bad: str, *arriving: DisplayFrame) -> None:
        """Forget all frames, and name the frame whose plane ``bad`` is not finite: perhaps an earlier one, whose check is still open."""
        frames = [each.frame for each in self._chain if each.frame is not None]
        self.forget()
        for frame in (*frames, *arriving):
            array = getattr(frame, bad)
            if array is not None:
                require_finite(bad, array.get() if isinstance(array, cla.Array) else array)

    def forget(self) -> None:
        """Forget all frames: the next one follows none."""
        self._drop(*self._chain)
        self._chain.clear()

    def _drop(self, *frames: UploadedFrame) -> None:
        """Let go of the arrays of frames; launches that were enqueued may still read them."""
        if any(frame.planes for frame in frames):
            for frame in frames:
                frame.let_go()
            self._planes.dropped()

    def changed(self, first: int, last: int) -> Tiles | None:
        """Where something moves or differs in the frames numbered ``first`` + 1 .. ``last``; None: unknown, so possibly everywhere."""
        return self._either([frame.changed for frame in self._chain if first < frame.number <= last], last - first)

    def color_changed(self, one: int, other: int) -> Tiles | None:
        """Where the colours of two frames may differ, by their numbers; None: unknown, so possibly everywhere."""
        first, last = sorted((one, other))
        return self._either([frame.recolored for frame in self._chain if first < frame.number <= last], last - first)

    def _either(self, maps: list[Tiles | None], count: int) -> Tiles | None:
        masks = [tiles for tiles in maps if tiles is not None]
        return np.logical_or.reduce([*masks, np.zeros(self._shape, np.bool_)]) if len(masks) == count else None

    def _arrive(self, frame: DisplayFrame, window: Sequence[UploadedFrame], *, compare: bool) -> None:
        """Upload and compare a frame; ``window`` has the frames before it that its output also reads."""
        height, width = self.size
        shapes = {"motion": (2,), "gbuffer": (9,), "nov": (), "stencil": (), "position": (3,)}
        arrays: dict[str, tuple[Plain, tuple[int, ...]]] = {
            n: (getattr(frame, n), (height, width, *c)) for n, c in shapes.items()
        }
        if frame.color is not None:
            arrays["color"] = frame.color, (height, width, 3)
        planes = self._planes.bring(arrays)
        color = planes.pop("color", None)
        before = window[-1].planes if window and compare else None
        color_before = (
            next((earlier.color for earlier in reversed(window) if earlier.color is not None), None) if compare else None
        )
        bad, changed, recolored = self._arrival.look(planes, color, before, color_before)
        if bad is not None:
            self._refuse(bad, frame)
        if color is None and compare:
            recolored = np.zeros(self._shape, np.bool_)
        if len(self._chain) == MOST_FRAMES:
            self._drop(self._chain.popleft())
        self._chain.append(UploadedFrame(frame, self._count, planes, color, changed, recolored))
        self._count += 1


def sources(frames: Sequence[UploadedFrame], steps: tuple[int, int, int]) -> Sources:
    """The inputs of stage ``frame`` for the last of ``frames``, which are consecutive frames; the steps lead to frames with colour."""
    back = frames[::-1]
    now, colors = back[0].planes, [back[step] for step in steps]
    views = [now, *(frame.planes for frame in colors)]
    return Sources(
        steps=steps,
        colors=tuple(frame.color for frame in colors if frame.color is not None),
        motions=tuple(frame.planes["motion"] for frame in back[: steps[2]]),
        gbuffer=now["gbuffer"],
        nov=now["nov"],
        stencils=tuple(planes["stencil"] for planes in views),
        normals=tuple(planes["gbuffer"] for planes in views),
        positions=tuple(planes["position"] for planes in views),
        normal_stride=9,
    )
