# SPDX-License-Identifier: MIT
"""Upload the planes of display frames, while the device computes earlier frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
from numpy.typing import NDArray
from pyopencl.tools import ImmediateAllocator, MemoryPool

from stss_cl.device.buffers import Plain, incoming, on_device
from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil_div
from stss_cl.device.launch import Kernel
from stss_cl.device.program import program_for
from stss_cl.device.staging import after, so_far, staging
from stss_ref.arrays import require_dtype, require_shape

HALF = ("color", "gbuffer", "nov", "stencil")
"""Planes that may be half. A motion of 16 pixels would have steps of 1/64 pixel, a position of 1000 cm steps of 0.5 cm."""
GROUP = 64
"""Work-group of widen.cl: fixed, see ``stss_cl.device.grid.grid``."""


class Planes:
    """Uploads planes. Planes of half are widened on the device, so afterwards all are float32.

    On a processor arrays of float32 are read in place. Otherwise uploads have their own queue, so that a frame's planes are
    uploaded while the previous frame is computed. They go to memory that only planes use, and that a dropped plane may have used before.
    So uploads wait for the launches before the last drop of planes (``dropped``).

    Attributes:
        queue: for uploads, and for the kernels that check the planes.
    """

    def __init__(self, device: Device):
        self._device = device
        self.queue = device.queue if device.is_cpu else staging(device).uploads
        # The allocator touches new memory in its queue; in the queue of launches that might be after the plane's upload.
        self._pool = MemoryPool(ImmediateAllocator(self.queue))
        self._readers: cl.Event | None = None
        self._some_arrive = False

    def dropped(self) -> None:
        """Note that planes were dropped: their memory may be reused once the launches so far have read them."""
        if not self._device.is_cpu:
            self._readers = so_far(self._device.queue)

    def bring(self, arrays: Mapping[str, tuple[Plain, tuple[int, ...]]]) -> dict[str, cl.Buffer]:
        """Enqueue the upload of a frame's planes, by name with their shapes; they are copied, or stay in place.

        Raises:
            ArrayError: a shape, dtype or context differs.
        """
        self._some_arrive = True
        if self._readers is not None:
            cl.enqueue_barrier(self.queue, wait_for=[self._readers])
            self._readers = None
        buffers = {name: self._buffer(name, array, shape) for name, (array, shape) in arrays.items()}
        if not self._device.is_cpu and any(isinstance(array, cla.Array) for array, _ in arrays.values()):
            # There the caller, and ``on_device``, may have enqueued the commands that make them.
            after(self.queue, self._device.queue)
        return {n: self._widened(buffers[n], math.prod(shape)) if _is_half(x) else buffers[n] for n, (x, shape) in arrays.items()}

    def arrived(self) -> None:
        """Let later launches wait for these uploads."""
        if self._some_arrive and not self._device.is_cpu:
            after(self._device.queue, self.queue)
        self._some_arrive = False

    def _buffer(self, name: str, plane: Plain, shape: tuple[int, ...]) -> cl.Buffer:
        array: Any = plane if isinstance(plane, cla.Array) else np.asarray(plane)
        require_shape(name, array, shape)
        dtype = np.float16 if _is_half(array) and name in HALF else np.float32
        if isinstance(array, cla.Array):
            return on_device(self._device, name, array, dtype)
        require_dtype(name, array, np.dtype(dtype))
        return incoming(self._device, array) if self._device.is_cpu else self._upload(array)

    def _upload(self, array: NDArray[Any]) -> cl.Buffer:
        buffer: Any = self._pool.allocate(array.nbytes)
        staging(self._device).write(buffer, array, self.queue)
        return buffer

    def _widened(self, half: cl.Buffer, count: int) -> cl.Buffer:
        target: Any = self._pool.allocate(4 * count)
        size = ceil_div(ceil_div(count, 4), GROUP) * GROUP
        self._widen.set(**{"from": half, "to": target, "count": count})
        event = self._widen.enqueue(self.queue, (size,), (GROUP,))
        if self._device.is_cpu:
            event.wait()  # the caller's array was read in place
        return target

    @cached_property
    def _widen(self) -> Kernel:
        """Built for the first plane of half."""
        return Kernel(program_for(self._device, "widen.cl"), "widen")


def _is_half(array: Plain) -> bool:
    return getattr(array, "dtype", None) == np.float16
