# SPDX-License-Identifier: MIT
"""Copy the network's inputs, plain arrays on the device, to the buffers of its first layers."""

from __future__ import annotations

from math import gcd

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import FLAGS, Inputs
from stss_cl.device.conversion import storage_options
from stss_cl.device.discovery import Device
from stss_cl.device.grid import grid
from stss_cl.device.launch import Kernel
from stss_cl.device.program import marking, program_for
from stss_cl.network.layer import FAST


class PackInputs:
    """The kernels that fill ``inputs`` for frames of (height, width)."""

    def __init__(self, device: Device, inputs: Inputs, height: int, width: int):
        self._device, self._inputs = device, inputs
        options = storage_options(device, inputs.input.dtype)
        program = program_for(device, "encoder.cl", {**options, "STREAM": device.is_pocl_processor, "ROW_AT_ONCE": device.is_cpu})
        eighth = program_for(device, "downsample_8.cl", {"MASK": "float", **options, **marking(device, marks=False)}, FAST)
        self._bad = cl.Buffer(device.context, FLAGS.READ_WRITE | FLAGS.COPY_HOST_PTR, hostbuf=np.zeros(2, np.int32))
        size = {"height": height, "width": width}
        full = {
            "input": inputs.input.data, "base": inputs.base, "bad": self._bad, "columns": inputs.input.columns, **size,
        }  # fmt: skip
        history = {
            "padded": inputs.earlier.data, "bad": self._bad, "rows": inputs.earlier.rows, "columns": inputs.earlier.columns, **size,
        }  # fmt: skip
        small = {
            "eighth": inputs.eighth.data, "down": inputs.eighth.height, "across": inputs.eighth.width,
            "columns": inputs.eighth.columns, "changes": None, "dirty": None, **size,
        }  # fmt: skip
        self._input, self._history = Kernel(program, "pack_input", full), Kernel(program, "pack_history", history)
        self._eighth = Kernel(eighth, "downsample_8", small)

    def __call__(self, color: cl.Buffer, gbuffer: cl.Buffer, mask: cl.Buffer, history: cl.Buffer | None, top: int) -> None:
        """Enqueue the copy; ``top`` is the row of the frame that is row 0 of ``inputs``. ``history``: None if no layer reads it."""
        to, queue = self._inputs, self._device.queue
        full, eighth = (to.input.width, to.input.height), (to.eighth.width, to.eighth.height)
        # A group that divides the width, a multiple of 8: a test in each work-item for the frame's end would cost a third of the time.
        group = gcd(to.input.width, 64), 1
        self._input.set(color=color, gbuffer=gbuffer, mask=mask, top=top)
        self._input.enqueue(queue, full, group)
        self._eighth.set(gbuffer=gbuffer, mask=mask, top=top)
        self._eighth.enqueue(queue, *grid(self._device, *eighth))
        if history is not None:
            size, group = ((1, full[1], 3), (1, 1)) if self._device.is_cpu else ((*full, 3), group)
            self._history.set(history=history, top=top)
            self._history.enqueue(queue, size, (*group, 1))

    def all_finite(self) -> bool:
        """Whether all inputs packed since the last call are finite; waits for the queue."""
        bad = np.empty(2, np.int32)
        cl.enqueue_copy(self._device.queue, bad, self._bad)
        if bad.any():
            cl.enqueue_fill_buffer(self._device.queue, self._bad, np.zeros(1, np.int32), 0, 8)
        return not bad.any()
