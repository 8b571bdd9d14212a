# SPDX-License-Identifier: MIT
"""What is looked for in a display frame that arrives: values that are not finite, and where it differs from the one before it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Protocol

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil_div
from stss_cl.device.parts import Parts, zeroed
from stss_cl.device.program import build
from stss_cl.device.staging import after, staging

Tiles = NDArray[np.bool_]
"""(ceil(H / 4), ceil(W / 4)): True where something changed in a tile of 4 x 4 pixels."""
SCANNERS = 64
"""Work-items of finite.cl."""
SPAN = 256
"""Tiles of a work-item of changed_tiles.cl."""
ITEMS, ACROSS = 128, 16
"""Work-items of a group of arrive.cl, and tiles of a row that it looks at."""
FINITE = ("color", "gbuffer", "nov", "stencil")
COMPARED = ("gbuffer", "nov", "stencil", "position")

Planes = Mapping[str, cl.Buffer]
Found = tuple[str | None, Tiles | None, Tiles | None]
"""Name of a plane that is not finite; where the frame differs from the one before it, and its colour from the last one before it; None
where nothing was compared."""


class Arrival(Protocol):
    """Looks at frames of one size."""

    def look(self, planes: Planes, color: cl.Buffer | None, before: Planes | None, color_before: cl.Buffer | None) -> Found:
        """Look at one.

        Args:
            planes: all but the colour.
            color: if it has one.
            before: those of the frame before it; None: it is compared with nothing.
            color_before: of the last frame before it that has one; None: likewise.
        """
        ...

    def not_finite(self) -> str | None:
        """Name of a plane that was not finite in a frame for which ``look`` did not wait; waits now."""
        ...


class ArrivalOnProcessor:
    """A few work-items, each with many tiles; see ``Arrival``."""

    def __init__(self, device: Device, height: int, width: int):
        self._device, self._size, self._shape = device, (height, width), (ceil_div(height, 4), ceil_div(width, 4))
        self._finite = cl.Kernel(build(device, "finite.cl"), "finite")
        self._map = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, self._shape[0] * self._shape[1])
        self._bad = zeroed(device, 4 * len(FINITE))

    @cached_property
    def _comparing(self) -> dict[str, cl.Kernel]:
        """Built when a second frame comes."""
        program = build(self._device, "changed_tiles.cl", {"SPAN": SPAN})
        return {name: cl.Kernel(program, name) for name in ("differ", "differ_color")}

    def look(self, planes: Planes, color: cl.Buffer | None, before: Planes | None, color_before: cl.Buffer | None) -> Found:
        """See ``Arrival``."""
        if color is not None:
            self._scan(color, 3, 0)
        if before is None:
            for which, (name, floats) in enumerate((("gbuffer", 9), ("nov", 1), ("stencil", 1)), start=1):
                self._scan(planes[name], floats, which)
        else:
            self._launch("differ", *planes.values(), *(before[name] for name in COMPARED), self._map, self._bad)
        bad = np.empty(len(FINITE), np.int32)
        cl.enqueue_copy(self._device.queue, bad, self._bad)
        if bad.any():
            cl.enqueue_fill_buffer(self._device.queue, self._bad, np.zeros(1, np.int32), 0, bad.nbytes)
            return FINITE[int(bad.argmax())], None, None
        changed = None if before is None else self._read_map()
        if color is None or color_before is None:
            return None, changed, None
        self._launch("differ_color", color, color_before, self._map)
        return None, changed, self._read_map()

    def not_finite(self) -> str | None:
        """See ``Arrival``: ``look`` waits always."""
        return None

    def _launch(self, name: str, *arguments: cl.Buffer) -> None:
        size = ceil_div(self._shape[1], SPAN), self._shape[0]
        # A group that does not follow the size, see stss_cl.device.grid.grid; one work-item does much.
        self._comparing[name](self._device.queue, size, (1, 1), *arguments, *map(np.int32, self._size))

    def _scan(self, buffer: cl.Buffer, floats: int, which: int) -> None:
        """Enqueue a look at all values of a plane: ``bad[which]`` becomes 1 if one of them is not finite."""
        count = np.uint64(self._size[0] * self._size[1] * floats)
        self._finite(self._device.queue, (SCANNERS,), None, buffer, count, self._bad, np.int32(which))

    def _read_map(self) -> Tiles:
        tiles = np.empty(self._shape, np.uint8)
        cl.enqueue_copy(self._device.queue, tiles, self._map)
        return tiles.view(np.bool_)


class ArrivalOnGpu:
    """One launch; where frames are compared, one small read for all that it found; else nobody waits. See ``Arrival``."""

    def __init__(self, device: Device, height: int, width: int):
        self._device, self._size, self._shape = device, (height, width), (ceil_div(height, 4), ceil_div(width, 4))
        self._kernel = cl.Kernel(build(device, "arrive.cl"), "arrive")
        tiles = self._shape[0] * self._shape[1]
        self._found = Parts(device, (16, tiles, tiles))  # bad, changed, recolored
        self._queue = staging(device).uploads
        after(self._queue, device.queue)  # which clears them
        self._unread = False

    def look(self, planes: Planes, color: cl.Buffer | None, before: Planes | None, color_before: cl.Buffer | None) -> Found:
        """See ``Arrival``."""
        compares, recolors = before is not None, color is not None and color_before is not None
        earlier = planes if before is None else before
        shown = planes["position"] if color is None else color
        arguments = (*planes.values(), shown, *(earlier[name] for name in COMPARED), color_before if recolors else shown)
        numbers = *self._size, color is not None, compares, recolors
        size = ITEMS * ceil_div(self._shape[1], ACROSS), self._shape[0]
        # In the queue of what arrives: the host waits for what is found, and not for the frame before.
        self._kernel(self._queue, size, (ITEMS, 1), *arguments, *self._found.buffers, *map(np.int32, numbers))
        self._unread = not compares and not recolors
        if self._unread:
            return None, None, None
        found, changed, recolored = self._found.read(self._queue)
        if bad := self._named(found.view(np.int32)):
            return bad, None, None
        return None, self._map(changed) if compares else None, self._map(recolored) if recolors else None

    def not_finite(self) -> str | None:
        """See ``Arrival``."""
        if not self._unread:
            return None
        bad = np.empty(len(FINITE), np.int32)
        cl.enqueue_copy(self._queue, bad, self._found.buffers[0])
        self._unread = False
        return self._named(bad)

    def _named(self, bad: NDArray[np.int32]) -> str | None:
        if not bad.any():
            return None
        cl.enqueue_fill_buffer(self._queue, self._found.buffers[0], np.zeros(1, np.int32), 0, bad.nbytes)
        return FINITE[int(bad.argmax())]

    def _map(self, tiles: NDArray[np.uint8]) -> Tiles:
        return tiles.reshape(self._shape).view(np.bool_)
