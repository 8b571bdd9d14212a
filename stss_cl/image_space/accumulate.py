# SPDX-License-Identifier: MIT
"""Stage accumulate for frames in turn: the caller's arrays are read and written in place on a processor."""

from __future__ import annotations

from collections.abc import Sequence
from threading import Lock

import pyopencl as cl

from stss_cl.device.buffers import Outgoing, incoming
from stss_cl.device.discovery import Device
from stss_cl.device.grid import grid
from stss_cl.device.launch import Kernel
from stss_cl.image_space.stages import accumulate_program, chain_program
from stss_ref.arrays import Image


class Accumulate:
    """`stss_ref.accumulate.accumulate` on one device, for float32 arrays that a backend made."""

    def __init__(self, device: Device):
        self._device = device
        self._alone = Lock()
        self._chain = Kernel(chain_program(device), "motion_of_two")
        self._kernel = Kernel(accumulate_program(device), "accumulate")
        self._images: list[tuple[Image, cl.Buffer]] = []
        """The images of the last call with their buffers: a device with memory of its own gets each once."""

    def __call__(self, image: Image, earlier: Sequence[Image], motions: Sequence[Image]) -> Image:
        """Mix an image with those of the one or two display frames before it; threads take turns.

        Args:
            image: of the display frame.
            earlier: of the frames before it, newest first.
            motions: the display frame's own motion, and with two earlier images that of the frame before it.

        Returns:
            A new array; see the reference.
        """
        device, (height, width, _) = self._device, motions[0].shape
        size = {"height": height, "width": width}
        with self._alone:
            shown = Outgoing(device, image.shape, on_device=False)
            self._images = [(array, self._buffer(array)) for array in (image, *earlier)]
            now, newer, *rest = (buffer for _, buffer in self._images)
            older = rest[0] if rest else newer
            # Held until the launches are done, which OpenCL does not.
            planes = [incoming(device, motion) for motion in motions]
            to_older = planes[0]
            if rest:
                to_older = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, motions[0].nbytes)
                self._chain.set(newer=planes[0], older=planes[1], motion=to_older, **size)
                self._chain.enqueue(device.queue, *grid(device, width, height))
            images = {"image": now, "newer": newer, "older": older}
            self._kernel.set(**images, to_newer=planes[0], to_older=to_older, shown=shown.data, count=len(earlier), **size)
            self._kernel.enqueue(device.queue, *grid(device, width, height))
            return shown.finish()

    def _buffer(self, image: Image) -> cl.Buffer:
        for array, buffer in self._images:
            if array is image:
                return buffer
        return incoming(self._device, image)
