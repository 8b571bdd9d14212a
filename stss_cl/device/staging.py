# SPDX-License-Identifier: MIT
"""Page-locked memory between the host's arrays and a device that is no processor: made once, used again, and copied without waiting."""

from __future__ import annotations

import math
import weakref
from collections import deque
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.discovery import Device

FLAGS = cl.mem_flags
MOST_FREE = 8
"""Pieces of a size that are kept while nobody uses them."""


class Staging:
    """The page-locked memory of one device.

    Attributes:
        aside: a second queue, for what must not wait for all that is in the device's own; what it does wait for it must name.
    """

    def __init__(self, device: Device):
        # Not the context itself: ``_made`` forgets what no context but this holds.
        self._queue, self._pool = device.queue, device.pool
        # A queue in order waits for all that is in it before it maps: new memory is mapped in one that is nearly empty.
        self.aside = cl.CommandQueue(device.context)
        self._free: dict[int, list[NDArray[np.uint8]]] = {}
        self._copying: deque[tuple[Any, NDArray[np.uint8]]] = deque()

    def upload(self, array: NDArray[Any]) -> cl.Buffer:
        """A buffer on the device with the content of ``array``, which may be written to at once; does not wait."""
        buffer: Any = self._pool.allocate(array.nbytes)
        self.write(buffer, array)
        return buffer

    def write(self, buffer: cl.Buffer, array: NDArray[Any]) -> None:
        """Enqueue that ``buffer`` gets the content of ``array``, which may be written to at once."""
        while self._copying and self._copying[0][0].command_execution_status == cl.command_execution_status.COMPLETE:
            self._give_back(self._copying.popleft()[1])
        locked = self._take(array.nbytes)
        np.copyto(locked[: array.nbytes].view(array.dtype).reshape(array.shape), array)
        event = cl.enqueue_copy(self._queue, buffer, locked[: array.nbytes], is_blocking=False)
        self._copying.append((event, locked))  # an event that nobody holds waits for its end

    def array(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Page-locked float32 to be handed out: it serves again when nobody holds it, or a view of it, any more."""
        size = 4 * math.prod(shape)
        locked = self._take(size)
        held: Any = locked
        made = np.frombuffer(memoryview(held), np.float32, math.prod(shape)).reshape(shape)
        whole: Any = made.base
        weakref.finalize(whole, self._give_back, locked).atexit = False
        return made

    def _take(self, size: int) -> NDArray[np.uint8]:
        free = self._free.setdefault(size, [])
        if free:
            return free.pop()
        buffer = cl.Buffer(self._queue.context, FLAGS.READ_WRITE | FLAGS.ALLOC_HOST_PTR, size)
        how: Any = cl.map_flags.READ | cl.map_flags.WRITE
        bytes_: Any = np.uint8
        return cl.enqueue_map_buffer(self.aside, buffer, how, 0, (size,), bytes_)[0]

    def _give_back(self, locked: NDArray[np.uint8]) -> None:
        free = self._free[locked.nbytes]
        if len(free) < MOST_FREE:
            free.append(locked)


_made: WeakKeyDictionary[cl.Context, Staging] = WeakKeyDictionary()


def staging(device: Device) -> Staging:
    """That of this device; made once."""
    if device.context not in _made:
        _made[device.context] = Staging(device)
    return _made[device.context]
