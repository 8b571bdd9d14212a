# SPDX-License-Identifier: MIT
"""Memory of zeros; small buffers that are parts of a large one, so that they are cleared and read at once."""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil_div

FLAGS = cl.mem_flags

HUGE_PAGE = 2 << 20


def make_zeros(device: Device, size: int) -> cl.Buffer:
    """Allocate ``size`` bytes of zeros; on a CPU in huge pages where the system has them: a frame's rows lie far apart."""
    if device.is_cpu and size >= HUGE_PAGE and hasattr(mmap, "MADV_HUGEPAGE"):
        memory = mmap.mmap(-1, whole_pages(size), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        memory.madvise(mmap.MADV_HUGEPAGE)
        return cl.Buffer(device.context, FLAGS.READ_WRITE | FLAGS.USE_HOST_PTR, hostbuf=memory)
    data = cl.Buffer(device.context, FLAGS.READ_WRITE, size)
    cl.enqueue_fill_buffer(device.queue, data, np.zeros(1, np.uint8), 0, size)
    return data


def whole_pages(size: int) -> int:
    """Most bytes that ``make_zeros`` allocates for ``size`` bytes."""
    return size if size < HUGE_PAGE else -(-size // HUGE_PAGE) * HUGE_PAGE


class Parts:
    """Buffers of these sizes, in bytes, filled with zeros.

    Attributes:
        whole: the one buffer.
        firsts: the first byte of each in ``whole``, and the end.
        buffers: in the order of the sizes.
    """

    def __init__(self, device: Device, sizes: Sequence[int]):
        align = max(int(device.handle.mem_base_addr_align) // 8, 16)
        self._device, self._sizes = device, tuple(sizes)
        self.firsts = tuple(accumulate((ceil_div(size, align) * align for size in sizes), initial=0))
        self.whole = make_zeros(device, max(self.firsts[-1], align))
        self.buffers = tuple(self.whole.get_sub_region(first, size) for first, size in self._places())

    def clear(self) -> None:
        """Enqueue setting all bytes to 0."""
        cl.enqueue_fill_buffer(self._device.queue, self.whole, np.zeros(1, np.uint32), 0, self.whole.size)

    def read(self, queue: cl.CommandQueue | None = None) -> list[NDArray[np.uint8]]:
        """The bytes of each, by one read, which waits for the ``queue``, or for the device's own."""
        host: NDArray[Any] = np.empty(self.firsts[-1], np.uint8)
        cl.enqueue_copy(self._device.queue if queue is None else queue, host, self.whole)
        return [host[first : first + size] for first, size in self._places()]

    def _places(self) -> list[tuple[int, int]]:
        return list(zip(self.firsts, self._sizes, strict=False))
