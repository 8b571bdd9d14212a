# SPDX-License-Identifier: MIT
"""Check a display frame as it arrives: find values that are not finite, and places that differ from the frame before it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil_div
from stss_cl.device.launch import Kernel
from stss_cl.device.parts import Parts
from stss_cl.device.program import program_for
from stss_cl.device.staging import after, staging

Tiles = NDArray[np.bool_]
"""(ceil(H / 4), ceil(W / 4)): True where something changed in a tile of 4 x 4 pixels."""
SPAN = 256
"""Tiles of a work-item of changed_tiles.cl."""
ITEMS, ACROSS = 128, 16
"""Work-items of a group of arrive.cl, and tiles of a row that it looks at."""
CHANGED, RECOLORED = 1, 2
"""Bits of a tile's result (kernels/arrive.clh)."""
FINITE = ("color", "gbuffer", "nov", "stencil")
COMPARED = ("gbuffer", "nov", "stencil", "position")

Planes = Mapping[str, cl.Buffer]
Findings = tuple[str | None, Tiles | None, Tiles | None]
"""Name of a plane that is not finite; the tiles that differ from the previous frame; those whose colour differs from the previous colour;
None: all is finite, or nothing was compared."""


class Arrival:
    """Checks and compares frames of one size, in one launch. A comparison needs a read of the result; without one no GPU is waited for."""

    def __init__(self, device: Device, height: int, width: int):
        self._device, self._size, self._shape = device, (height, width), (ceil_div(height, 4), ceil_div(width, 4))
        rows, columns = self._shape
        self._marks = Parts(device, (16, rows * columns))  # bad, differs
        if device.is_cpu:
            self._queue, self._groups = device.queue, ((ceil_div(columns, SPAN), rows), (1, 1))
            program = program_for(device, "changed_tiles.cl", {"SPAN": SPAN, "PREFETCH": device.takes_prefetch})
        else:
            # In the queue of arriving planes: the host waits for the result, and not for the previous frame.
            self._queue, self._groups = staging(device).uploads, ((ITEMS * ceil_div(columns, ACROSS), rows), (ITEMS, 1))
            after(self._queue, device.queue)  # which clears them
            program = program_for(device, "arrive.cl")
        bad, differs = self._marks.buffers
        self._kernel = Kernel(program, "arrive", {"bad": bad, "differs": differs, "height": height, "width": width})
        self._unread = False

    def load(self) -> None:
        """Have the runtime load or compile the kernel, at a frame of no rows."""
        self._kernel.load(self._queue, *self._groups, {"height": 0}, {"height": self._size[0]})

    def look(self, planes: Planes, color: cl.Buffer | None, before: Planes | None, color_before: cl.Buffer | None) -> Findings:
        """Look at a frame.

        Args:
            planes: all but the colour.
            color: if it has one.
            before: those of the frame before it; None: it is compared with nothing.
            color_before: of the last frame before it that has one; None: likewise.
        """
        compares, recolors = before is not None, color is not None and color_before is not None
        earlier = planes if before is None else before
        plane = planes["position"] if color is None else color
        self._kernel.set(
            **planes, color=plane, color_before=color_before if recolors else plane,
            **{f"{name}_before": earlier[name] for name in COMPARED},
            has_color=color is not None, compares=compares, recolors=recolors,
        )  # fmt: skip
        self._kernel.enqueue(self._queue, *self._groups)
        self._unread = not compares and not recolors
        if self._unread:
            return self.not_finite() if self._device.is_cpu else None, None, None
        bad_marks, differs = self._marks.read(self._queue)
        if bad := self._name_of_plane(bad_marks.view(np.int32)):
            return bad, None, None
        return None, self._map(differs, CHANGED) if compares else None, self._map(differs, RECOLORED) if recolors else None

    def not_finite(self) -> str | None:
        """Name of a plane that was not finite in a frame for which ``look`` did not wait; waits now."""
        if not self._unread:
            return None
        bad = np.empty(len(FINITE), np.int32)
        cl.enqueue_copy(self._queue, bad, self._marks.buffers[0])
        self._unread = False
        return self._name_of_plane(bad)

    def _name_of_plane(self, bad: NDArray[np.int32]) -> str | None:
        if not bad.any():
            return None
        cl.enqueue_fill_buffer(self._queue, self._marks.buffers[0], np.zeros(1, np.int32), 0, bad.nbytes)
        return FINITE[int(bad.argmax())]

    def _map(self, differs: NDArray[np.uint8], bit: int) -> Tiles:
        return (differs.reshape(self._shape) & bit) != 0
