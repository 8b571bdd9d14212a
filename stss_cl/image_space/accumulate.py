# SPDX-License-Identifier: MIT
"""Stage accumulate for frames in turn: the caller's arrays are read and written in place on a processor."""

from __future__ import annotations

from threading import Lock

from stss_cl.device.buffers import Outgoing, incoming
from stss_cl.device.discovery import Device
from stss_cl.device.grid import grid
from stss_cl.device.launch import Kernel
from stss_cl.image_space.stages import accumulate_program
from stss_ref.arrays import Image


class Accumulate:
    """`stss_ref.accumulate.accumulate` on one device, for float32 arrays that a backend made."""

    def __init__(self, device: Device):
        self._device = device
        self._alone = Lock()
        self._kernel = Kernel(accumulate_program(device), "accumulate")

    def __call__(self, image: Image, before: Image, motion: Image) -> Image:
        """Mix two images; see the reference. Returns a new array; threads take turns."""
        height, width, _ = motion.shape
        with self._alone:
            shown = Outgoing(self._device, image.shape, on_device=False)
            # Held until the launch is done, which OpenCL does not.
            planes = {
                name: incoming(self._device, array) for name, array in (("image", image), ("before", before), ("motion", motion))
            }
            self._kernel.set(**planes, shown=shown.data, height=height, width=width)
            self._kernel.enqueue(self._device.queue, *grid(self._device, width, height))
            return shown.finish()
