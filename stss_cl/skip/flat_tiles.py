# SPDX-License-Identifier: MIT
"""Flat tiles: where colour and surface are flat the decoder has next to nothing to add, and is not run (kernels/flat_tiles.cl)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.buffers import Inputs, map_bytes, zeroed
from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil_div, grid
from stss_cl.device.program import build
from stss_cl.network.launch import Launch

DIVISORS = (1, 2, 4)
"""The decoder's sizes, as divisors of the frame's."""
DEPARTURE_IMAGE = 2
"""Which argument of ``departure`` is the image."""


class FlatTiles:
    """The network's launches, the decoder's among them computing only what is wanted.

    Args:
        device: to run on.
        launches: of the whole network, with ``skip``.
        inputs: what they read.
        mask: (height, width) uint8, 1 = not a hole of the newest frame, a buffer.
        size: height and width of the frame.
        flat: the largest second difference of a colour that counts as flat, in units of the image.
    """

    def __init__(
        self,
        device: Device,
        launches: Sequence[Launch],
        inputs: Inputs,
        mask: cl.Buffer,
        size: tuple[int, int],
        flat: float,
    ):
        self._device = device
        self._tiles = [(ceil_div(inputs.input.height // d, 4), ceil_div(inputs.input.width // d, 4)) for d in DIVISORS]
        self._maps = [zeroed(device, map_bytes(4 * rows, 4 * columns)) for rows, columns in self._tiles]
        program = build(device, "flat_tiles.cl")
        self._detail, self._coarser = cl.Kernel(program, "detail"), [cl.Kernel(program, "coarser") for _ in DIVISORS[1:]]
        self._held = inputs.base, mask
        for argument, value in enumerate((*self._held, self._maps[0], *map(np.int32, size), np.float32(flat)), 1):
            self._detail.set_arg(argument, value)  # the first is the G-buffer
        for kernel, fine, out, (rows, columns) in zip(self._coarser, self._maps, self._maps[1:], self._tiles, strict=False):
            kernel.set_args(fine, out, np.int32(rows), np.int32(columns))
        self._apart = zeroed(device, 4 * self._tiles[0][0] * self._tiles[0][1])
        self._departure = cl.Kernel(program, "departure")
        self._departure.set_args(self._maps[0], inputs.base, inputs.base, self._apart, *map(np.int32, size))
        self._launches = list(self._replaced(launches))

    def read(self, gbuffer: cl.Buffer) -> None:
        """From now on ``gbuffer`` (height, width, 9) is the frame's: to be called before all others."""
        self._detail.set_arg(0, gbuffer)

    def ready(self, image: cl.Buffer) -> list[Launch]:
        """Enqueue the search for what is wanted; the launches in order, the last of them to write all of ``image``."""
        for kernel, size in zip((self._detail, *self._coarser), self._tiles, strict=True):
            self._enqueue(kernel, size)
        self._launches[-1].set(image=image)
        return self._launches

    def departure(self, image: cl.Buffer) -> float:
        """How far ``image``, which the whole network made, lies from what it were with flat tiles left out; waits for it."""
        self._departure.set_arg(DEPARTURE_IMAGE, image)
        self._enqueue(self._detail, self._tiles[0])
        self._enqueue(self._departure, self._tiles[0])
        apart = np.empty(self._tiles[0], np.float32)
        cl.enqueue_copy(self._device.queue, apart, self._apart)
        return float(apart.max())

    def _enqueue(self, kernel: cl.Kernel, tiles: tuple[int, int]) -> None:
        cl.enqueue_nd_range_kernel(self._device.queue, kernel, *grid(self._device, *tiles[::-1]))

    def wanted(self) -> NDArray[np.bool_]:
        """Which tiles of the frame were no flat ones, (rows / 4, columns / 4) of the padded frame; waits for the queue."""
        return self.maps()[0]

    def maps(self) -> list[NDArray[np.bool_]]:
        """The same, and the decoder's maps at a half and a quarter of the size."""
        made = [np.empty(size, np.uint8) for size in self._tiles]
        for array, held in zip(made, self._maps, strict=True):
            cl.enqueue_copy(self._device.queue, array, held)
        return [array.astype(np.bool_) for array in made]

    def _replaced(self, launches: Sequence[Launch]) -> Iterator[Launch]:
        coarse = len(DIVISORS)
        for launch in launches:
            if launch.stage != "decoder":
                yield launch
                continue
            coarse -= launch.name == "upsample_corners"
            before_last = launch.name == "upsample_corners" or launch.name.endswith(".0")
            yield _wanted_only(self._device, launch, self._maps[coarse], reach=int(before_last))


def _wanted_only(device: Device, launch: Launch, wanted: cl.Buffer, *, reach: int) -> Launch:
    assert launch.skip is not None
    return launch.skipping(device, {"WANTED": reach}, {"wanted": wanted, **launch.skip.numbers})
