# SPDX-License-Identifier: MIT
"""Page-locked memory between the host's arrays and a GPU: allocated once, reused, and copied without waiting."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.discovery import Device
from stss_cl.device.recycling import Block, Recycler

FLAGS = cl.mem_flags
MOST_FREE = 64
"""Most unused blocks that are kept."""


class Staging:
    """The page-locked memory of one device.

    Attributes:
        uploads, downloads: a queue for each; the device's own queue has the launches. Only events order them.
    """

    def __init__(self, device: Device):
        # Not the context itself, which would keep its own entry of ``_by_context`` alive.
        self._queue, self._pool = device.queue, device.pool
        self.uploads, self.downloads = cl.CommandQueue(device.context), cl.CommandQueue(device.context)
        # An in-order queue finishes all its commands before it maps: so new memory is mapped in an empty queue.
        self._mapping = cl.CommandQueue(device.context)
        self._blocks = Recycler(self._lock, MOST_FREE)
        self._copying: list[tuple[Any, Block]] = []

    def upload(self, array: NDArray[Any]) -> cl.Buffer:
        """A buffer on the device with the content of ``array``, which may be written to at once; does not wait."""
        buffer: Any = self._pool.allocate(array.nbytes)
        self.write(buffer, array)
        return buffer

    def write(self, buffer: cl.Buffer, array: NDArray[Any], queue: cl.CommandQueue | None = None) -> None:
        """Enqueue a copy of ``array`` to ``buffer``; ``array`` may be written to at once. Without ``queue``: in the device's queue."""
        copying, self._copying = self._copying, []
        for event, block in copying:
            if event.command_execution_status == cl.command_execution_status.COMPLETE:
                self._blocks.give_back(block)
            else:
                self._copying.append((event, block))  # dropping an event would wait for its end
        block = self._blocks.take(array.nbytes)
        np.copyto(block[: array.nbytes].view(array.dtype).reshape(array.shape), array)
        where = self._queue if queue is None else queue
        self._copying.append((cl.enqueue_copy(where, buffer, block[: array.nbytes], is_blocking=False), block))
        where.flush()  # the device begins while the next array is brought into page-locked memory

    def array(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        """Page-locked memory for the caller, as `Recycler.array`."""
        return self._blocks.array(shape, dtype)

    def _lock(self, size: int) -> Block:
        buffer = cl.Buffer(self._queue.context, FLAGS.READ_WRITE | FLAGS.ALLOC_HOST_PTR, size)
        how: Any = cl.map_flags.READ | cl.map_flags.WRITE
        bytes_: Any = np.uint8
        return cl.enqueue_map_buffer(self._mapping, buffer, how, 0, (size,), bytes_)[0]


_by_context: WeakKeyDictionary[cl.Context, Staging] = WeakKeyDictionary()


def after(queue: cl.CommandQueue, other: cl.CommandQueue) -> None:
    """Let all later commands of ``queue`` wait for those now in ``other``."""
    cl.enqueue_barrier(queue, wait_for=[so_far(other)])


def so_far(queue: cl.CommandQueue) -> cl.Event:
    """The end of a queue's commands so far, for another queue to wait for."""
    event = cl.enqueue_marker(queue)
    queue.flush()  # a queue may wait for events of another for ever if that one's commands are not sent to the device
    return event


def staging(device: Device) -> Staging:
    """The staging memory of this device; made once."""
    if device.context not in _by_context:
        _by_context[device.context] = Staging(device)
    return _by_context[device.context]
