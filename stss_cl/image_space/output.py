# SPDX-License-Identifier: MIT
"""From the network's image to the caller's: planes carried past the network, and the transfer back (spec 9)."""

from __future__ import annotations

from threading import Lock

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import FLAGS, Outgoing, incoming
from stss_cl.device.discovery import Device
from stss_cl.device.grid import grid
from stss_cl.device.launch import Kernel
from stss_cl.image_space.stages import program
from stss_ref.arrays import Array, Image

CURVE_ERROR = 10 * 2.0**-24
"""Largest relative error of the inverse sRGB curve; kernels/output.cl derives it."""


class OutputKernels:
    """`carry` and `decode` on one device, for float32 arrays; threads take turns. On a processor arrays are read and written in place."""

    def __init__(self, device: Device):
        self._device = device
        self._alone = Lock()
        of = program(device, "output.cl")
        self._move, self._enlarge, self._decode = (Kernel(of, name) for name in ("move", "enlarge", "decode"))

    def load(self) -> None:
        """Let the runtime compile or load the kernels, which it does when they are launched first."""
        self.carry(np.zeros((1, 1, 1), np.float32), np.zeros((1, 1, 2), np.float32))
        self.decode(np.zeros((2, 2, 3), np.float32), (0.0, 1.0), srgb=True, above=None)

    def carry(self, plane: Array, motion: Image | None) -> Image:
        """Bring a plane of the newest rendered frame to the size and time of the output, bit for bit as the reference does.

        Args:
            plane: (H, W, C), finite.
            motion: (H, W, 2) px, that leads from the display frame to the rendered one; None: they are the same frame.

        Returns:
            (2H, 2W, C).
        """
        device, (height, width, channels) = self._device, plane.shape
        size = {"height": height, "width": width, "channels": channels}
        with self._alone:
            data = incoming(device, plane)
            if motion is not None:
                # Held until the launches are done, which OpenCL does not.
                still, moves = data, incoming(device, motion)
                data = cl.Buffer(device.context, FLAGS.READ_WRITE, plane.nbytes)
                self._move.set(plane=still, motion=moves, moved=data, **size)
                self._move.enqueue(device.queue, *grid(device, width, height))
            enlarged = Outgoing(device, (2 * height, 2 * width, channels), on_device=False)
            self._enlarge.set(plane=data, enlarged=enlarged.data, **size)
            self._enlarge.enqueue(device.queue, *grid(device, width, height))
            return enlarged.finish()

    def decode(self, image: Image, white: tuple[float, float], *, srgb: bool, above: Image | None) -> Image:
        """Clip an image, take it back through the sRGB curve, and give white pixels their highlights.

        The relative error of the curve is at most `CURVE_ERROR`.

        Args:
            image: (2H, 2W, 3) display-referred, finite.
            white: a pixel below the first value gets nothing of ``above``, one over the second the whole of it.
            srgb: whether there is a curve.
            above: (2H, 2W, 3) at least 0; None: there are no highlights.

        Returns:
            (2H, 2W, 3).
        """
        device, (height, width) = self._device, (image.shape[0] // 2, image.shape[1] // 2)
        low, high = white
        with self._alone:
            data, color = incoming(device, image), Outgoing(device, image.shape, on_device=False)
            highlights = data if above is None else incoming(device, above)
            self._decode.set(image=data, above=highlights, color=color.data, height=height, width=width)
            self._decode.set(srgb=srgb, highlights=above is not None, low=low, span=high - low)
            self._decode.enqueue(device.queue, *grid(device, width, height))
            return color.finish()
