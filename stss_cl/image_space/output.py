# SPDX-License-Identifier: MIT
"""From the network's image to the caller's: planes carried past the network, and the transfer back (spec 9)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import Outgoing, Plain, incoming
from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil_div, grid
from stss_cl.device.launch import Kernel
from stss_cl.image_space.stages import program
from stss_ref.arrays import Array, Image, require_finite

CURVE_ERROR = 10 * 2.0**-24
"""Largest relative error of the inverse sRGB curve; kernels/output.cl derives it."""


class OutputKernels:
    """The kernels of output.cl on one device, for float32 arrays, in place on a processor; for one thread at a time."""

    def __init__(self, device: Device):
        self._device = device
        of = program(device, "output.cl")
        self._move, self._enlarge, self._decode = (Kernel(of, name) for name in ("move", "enlarge", "decode"))

    def load(self) -> None:
        """Let the runtime compile or load the kernels, which it does when they are launched first."""
        plane, motion = np.zeros((1, 1, 1), np.float32), np.zeros((1, 1, 2), np.float32)
        self.deliver(np.zeros((2, 2, 3), np.float32), {"": plane}, motion, srgb=True)

    def deliver(
        self,
        image: Plain,
        planes: Mapping[str, Array],
        motion: Plain | None,
        *,
        srgb: bool,
        highlights: str | None = None,
        white: tuple[float, float] = (0, 1),
    ) -> tuple[Image, dict[str, Image]]:
        """Bring an image, and the planes carried past the network, to the host, at the size, time and transfer of the output.

        An image is clipped and taken back through the sRGB curve, with a relative error of at most `CURVE_ERROR`; then white pixels get
        their highlights. Planes have the reference's bits.

        Args:
            image: (2H, 2W, 3) display-referred.
            planes: (H, W, C) each, of the newest rendered frame; finite.
            motion: (H, W, 2) px, that leads from the display frame to the rendered one; None: they are the same frame.
            srgb: whether there is a curve.
            highlights: the plane (H, W, 3) that is at least 0 and is added to white pixels; None, or not there: nothing is.
            white: a pixel below the first value gets nothing of ``highlights``, one over the second the whole of it.

        Returns:
            (2H, 2W, 3), and (2H, 2W, C) of each plane but ``highlights``.

        Raises:
            ArrayError: ``image`` is not finite.
        """
        device, (height, width) = self._device, (image.shape[0] // 2, image.shape[1] // 2)
        data, way = incoming(device, image), None if motion is None else incoming(device, motion)
        bad = Outgoing(device, (1,), np.int32, on_device=False)
        cl.enqueue_fill_buffer(device.queue, bad.data, np.zeros(1, np.int32), 0, 4)
        carried = {name: self._carry(plane, way, is_read_here=name == highlights) for name, plane in planes.items()}
        above = carried.pop(highlights, None) if highlights is not None else None
        color = Outgoing(device, image.shape, on_device=False)
        low, high = white
        self._decode.set(image=data, above=data if above is None else above.data, color=color.data, bad=bad.data)
        self._decode.set(srgb=srgb, highlights=above is not None, low=low, span=high - low, height=height, width=width)
        self._decode.enqueue(device.queue, *grid(device, width, ceil_div(height, 2)))
        for each in (bad, color, *carried.values()):
            each.send()
        if bad.finish()[0]:
            require_finite("image", image if isinstance(image, np.ndarray) else image.get())
        return color.finish(), {name: each.finish() for name, each in carried.items()}

    def _carry(self, plane: Array, motion: cl.Buffer | None, *, is_read_here: bool) -> Outgoing:
        """Enqueue bringing a plane to the size and time of the output; ``is_read_here``: it need not come to the host."""
        device, (height, width, channels) = self._device, plane.shape
        size = {"height": height, "width": width, "channels": channels}
        data = incoming(device, plane)
        if motion is not None:
            moved = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, plane.nbytes)
            self._move.set(plane=data, motion=motion, moved=moved, **size)
            self._move.enqueue(device.queue, *grid(device, width, height))
            data = moved
        enlarged = Outgoing(device, (2 * height, 2 * width, channels), on_device=is_read_here)
        self._enlarge.set(plane=data, enlarged=enlarged.data, **size)
        self._enlarge.enqueue(device.queue, *grid(device, width, height))
        return enlarged
