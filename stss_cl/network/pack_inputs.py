# SPDX-License-Identifier: MIT
"""Copy the network's inputs, plain arrays on the device, to the buffers of its first layers."""

from __future__ import annotations

from math import gcd

import numpy as np
import pyopencl as cl

from stss_cl.device import amx
from stss_cl.device.buffers import FLAGS, Inputs
from stss_cl.device.discovery import Device
from stss_cl.device.grid import grid
from stss_cl.device.program import build, marking
from stss_cl.network.layer import FAST, FLUSH


class PackInputs:
    """The kernels that fill ``inputs`` for frames of (height, width)."""

    def __init__(self, device: Device, inputs: Inputs, height: int, width: int):
        self._device, self._inputs, self._size = device, inputs, (np.int32(height), np.int32(width))
        options = amx.stored_as(device, inputs.input.dtype)
        program = build(device, "encoder.cl", {**options, "STREAM": device.streams, "ROWS": device.is_cpu}, FLUSH)
        eighth = build(device, "downsample_8.cl", {"MASK": "float", **options, **marking(device, marks=False)}, FAST)
        self._input, self._history = cl.Kernel(program, "pack_input"), cl.Kernel(program, "pack_history")
        self._eighth = cl.Kernel(eighth, "downsample_8")
        self._bad = cl.Buffer(device.context, FLAGS.READ_WRITE | FLAGS.COPY_HOST_PTR, hostbuf=np.zeros(2, np.int32))

    def __call__(self, color: cl.Buffer, gbuffer: cl.Buffer, mask: cl.Buffer, history: cl.Buffer | None, top: int) -> None:
        """Enqueue the copy; ``top`` is the row of the frame that is row 0 of ``inputs``. ``history``: None where nothing reads it."""
        to, size, first = self._inputs, self._size, np.int32(top)
        full, eighth = (to.input.width, to.input.height), (to.eighth.width, to.eighth.height)
        queue, columns = self._device.queue, np.int32(to.input.columns)
        # A group that divides the width, a multiple of 8: a test in each work-item for the frame's end would cost a third of the time.
        group = gcd(to.input.width, 64), 1
        self._input(queue, full, group, color, gbuffer, mask, to.input.data, to.base, self._bad, *size, columns, first)
        place = np.int32(to.eighth.height), np.int32(to.eighth.width), np.int32(to.eighth.columns), first
        self._eighth(queue, *grid(self._device, *eighth), gbuffer, mask, to.eighth.data, *size, *place, None, mask)
        if history is not None:
            place = np.int32(to.earlier.rows), np.int32(to.earlier.columns), first
            size, group = ((1, full[1], 3), (1, 1)) if self._device.is_cpu else ((*full, 3), group)
            self._history(queue, size, (*group, 1), history, to.earlier.data, self._bad, *self._size, *place)

    def all_finite(self) -> bool:
        """Whether all inputs packed since the last call are finite; waits for the queue."""
        bad = np.empty(2, np.int32)
        cl.enqueue_copy(self._device.queue, bad, self._bad)
        if bad.any():
            cl.enqueue_fill_buffer(self._device.queue, self._bad, np.zeros(1, np.int32), 0, 8)
        return not bad.any()
