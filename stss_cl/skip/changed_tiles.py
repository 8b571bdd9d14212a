# SPDX-License-Identifier: MIT
"""Change maps: which tiles of a buffer differ from the last frame (kernels/change_map.clh)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import FLAGS, map_bytes
from stss_cl.device.discovery import Device
from stss_cl.device.program import build
from stss_cl.network.launch import IMAGE_ARGUMENT, Launch

FULL_MAPS, LEAST = 16, 1 << 16


class Maps:
    """Change maps that are cleared all at once: parts of few large buffers.

    Args:
        device: to make them on.
        height, width: of the largest.
    """

    def __init__(self, device: Device, height: int, width: int):
        self._device = device
        self._align = max(int(device.handle.mem_base_addr_align) // 8, 1)
        self._size = max(FULL_MAPS * map_bytes(height, width), LEAST)
        self._parents: list[cl.Buffer] = []
        self._used = self._size

    def take(self, height: int, width: int) -> cl.Buffer:
        """One more, for a buffer of this size."""
        size = map_bytes(height, width)
        if self._used + size > self._size:
            self._parents.append(cl.Buffer(self._device.context, FLAGS.READ_WRITE, self._size))
            self._used = 0
        part = self._parents[-1].get_sub_region(self._used, size)
        self._used += -(-size // self._align) * self._align
        return part

    def clear(self) -> None:
        """Enqueue that nothing is marked."""
        for parent in self._parents:
            cl.enqueue_fill_buffer(self._device.queue, parent, np.zeros(1, np.uint32), 0, self._size // 4 * 4)


EXACT = -1.0
"""The tolerance at which every bit counts."""


class ChangedOnly:
    """Launches that compute only what changed, made from those that compute everything, on the same buffers.

    Args:
        device: to run on.
        launches: all of them with ``skip``; the last one writes the image.
        maps: the change maps that they write.
    """

    def __init__(self, device: Device, launches: Iterable[Launch], maps: Maps):
        self._device, self._maps, self._tolerance = device, maps, EXACT
        self.launches = [_changed_only(device, launch) for launch in launches]

    def ready(self, image: cl.Buffer, tolerance: float) -> list[Launch]:
        """The launches in order, for maps that are clear."""
        tolerance = tolerance if tolerance > 0 else EXACT
        if tolerance != self._tolerance:
            self._tolerance = tolerance
            for launch in self.launches:
                if launch.skip and launch.skip.bounded:
                    launch.kernel.set_arg(len(launch.held) - 1, np.float32(tolerance))
        last = self.launches[-1].kernel
        last.set_arg(IMAGE_ARGUMENT[last.function_name], image)
        return self.launches

    def run(self, image: cl.Buffer, tolerance: float) -> None:
        """Enqueue them all; see ``Layers.run_changed``."""
        self._maps.clear()
        for launch in self.ready(image, tolerance):
            launch.enqueue(self._device.queue)
        self._device.queue.flush()


def _changed_only(device: Device, launch: Launch) -> Launch:
    skip = launch.skip
    assert skip is not None
    kernel = cl.Kernel(build(device, skip.file, {**skip.options, "SKIP": True}, skip.flags), launch.kernel.function_name)
    arguments = (*launch.held, *skip.arguments, *skip.numbers, *([np.float32(EXACT)] if skip.bounded else []))
    kernel.set_args(*arguments)
    return Launch(launch.stage, launch.name, kernel, skip.size, skip.group, arguments, skip)
