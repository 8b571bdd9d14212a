# SPDX-License-Identifier: MIT
"""Stage accumulate for frames in turn: images and motion may be on the host or on the device."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import Outgoing, Plain, incoming
from stss_cl.device.discovery import Device
from stss_cl.device.grid import grid
from stss_cl.device.launch import Kernel
from stss_cl.image_space.stages import accumulate_program, program
from stss_ref.arrays import ArrayError, require_dtype, require_shape
from stss_ref.constants import EARLIER_SHARES


class Accumulate:
    """`stss_ref.accumulate.accumulate` on one device, for float32 arrays that a backend made; for one thread at a time."""

    def __init__(self, device: Device):
        self._device = device
        self._chain = Kernel(program(device, "motion_chain.cl"), "motion_of_two")
        self._kernel = Kernel(accumulate_program(device), "accumulate")

    def __call__(self, image: Plain, earlier: Sequence[Plain], motions: Sequence[Plain]) -> Plain:
        """Mix an image with those of the one or two display frames before it.

        Args:
            image: (2H, 2W, 3) float32, finite, of the display frame.
            earlier: the same of the frames before it, newest first.
            motions: (H, W, 2) float32 px: the display frame's own motion, and with two earlier images that of the frame before it.

        Returns:
            (2H, 2W, 3) a new array; see the reference. On a GPU it is there, and perhaps not yet complete.

        Raises:
            ArrayError: a number, shape or dtype of arrays does not fit.
        """
        device, (height, width) = self._device, _size(image, earlier, motions)
        size = {"height": height, "width": width}
        shown = Outgoing(device, image.shape, on_device=not device.is_cpu)
        now, newer, *rest = (incoming(device, array) for array in (image, *earlier))
        older = rest[0] if rest else newer
        # Held until the launches are enqueued, which a kernel does not.
        planes = [incoming(device, motion) for motion in motions]
        to_older = planes[0]
        if rest:
            to_older = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, planes[0].size)
            self._chain.set(newer=planes[0], older=planes[1], motion=to_older, **size)
            self._chain.enqueue(device.queue, *grid(device, width, height))
        images = {"image": now, "newer": newer, "older": older}
        self._kernel.set(**images, to_newer=planes[0], to_older=to_older, shown=shown.data, count=len(earlier), **size)
        self._kernel.enqueue(device.queue, *grid(device, width, height))
        return shown.finish()


def _size(image: Plain, earlier: Sequence[Plain], motions: Sequence[Plain]) -> tuple[int, int]:
    """(H, W), if the arrays fit together."""
    if not 1 <= len(earlier) == len(motions) <= len(EARLIER_SHARES):
        raise ArrayError(f"earlier, motions: expected one or two each, as many of both, got {len(earlier)} and {len(motions)}")
    require_shape("motions[0]", motions[0], (None, None, 2))
    height, width, _ = motions[0].shape
    images = {"image": image, **{f"earlier[{n}]": array for n, array in enumerate(earlier)}}
    for name, array in {**images, **{f"motions[{n}]": array for n, array in enumerate(motions)}}.items():
        require_shape(name, array, (2 * height, 2 * width, 3) if name in images else (height, width, 2))
        require_dtype(name, array, np.dtype(np.float32))
    return height, width
