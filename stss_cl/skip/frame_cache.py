# SPDX-License-Identifier: MIT
"""The data kept of the last frame of a kind, SF or EF, from which the next one is computed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.cost import Part
from stss_cl.device.buffers import Outgoing
from stss_cl.device.discovery import Device
from stss_cl.device.staging import staging
from stss_cl.frame import preparation
from stss_cl.image_space.frame_planes import Sources
from stss_cl.network.layers import Layers
from stss_cl.skip.arrival import Tiles
from stss_cl.skip.change_control import MOST_CHANGED
from stss_cl.skip.last_image import LastImage
from stss_cl.skip.partial_network import PartialNetwork


@dataclass(frozen=True)
class Last:
    """The last frame of a kind: its number, the numbers of the oldest frame and of the colours that it read, and ``valid``.

    None: ``valid`` was not needed on the host.
    """

    number: int
    oldest: int
    steps: tuple[int, ...]
    colors: tuple[int, ...]
    valid: Outgoing | None


class FrameCache:
    """The data kept of the last frame of a kind. SF and EF have separate caches, since their inputs differ at every silhouette."""

    def __init__(self, device: Device, layers: Layers):
        self.layers, self.partial = layers, PartialNetwork(layers)
        self.prepare = preparation(device, layers)
        self.last: Last | None = None
        self._is_first = True
        self._device = device
        height, width = layers.size
        self.image = LastImage(device, (2 * height, 2 * width, 3))

    def read(self, steps: tuple[int, int, int]) -> tuple[int, ...]:
        """The steps whose colour frames these weights read."""
        return steps[: self.layers.colors_read]

    def prepare_inputs(self, sources: Sources, dirty: Tiles | None, *, looking: bool) -> float:
        """Fill the network's inputs.

        Args:
            sources: the frame's.
            dirty: where the inputs may differ from those of the last frame of the kind; None: everywhere.
            looking: whether to mark the tiles in which they differ.

        Returns:
            The share that changed, of `Cost`.
        """
        self._is_first, self.last = self.last is None, None  # if this fails half-way, the next frame must not use it
        self._mark(dirty)
        self.prepare.start(sources, looking=looking)
        self.prepare.strip()
        if self._is_first or not looking:
            return 1.0
        share = 1.0 if dirty is None else float(dirty.mean())
        return share if share <= MOST_CHANGED else self._changed_share()  # for a small share the host need not wait

    def load(self) -> None:
        """Let the runtime load or compile all kernels that any frame needs."""
        self.prepare.load()
        self.layers.load()
        self.partial.load()

    def execute(self, network: Part) -> None:
        """Run this part of the network."""
        if network == "changed":
            self.partial.run(self.image.target(whole=False))
        else:
            self.layers.run(self.image.target(whole=True))

    def _mark(self, dirty: Tiles | None) -> None:
        """Mark the tiles of the inputs to compute: the ``dirty`` ones, or all for None."""
        tiles = _spread(dirty, (self.prepare.rows, self.prepare.columns))
        if self._device.is_cpu:
            cl.enqueue_copy(self._device.queue, self.prepare.dirty, tiles, is_blocking=True)
        else:
            staging(self._device).write(self.prepare.dirty, tiles)

    def _changed_share(self) -> float:
        """The share of pixels whose inputs differ from the last ones; waits for them."""
        inputs = self.layers.inputs
        shares: list[float] = []
        for buffer in (inputs.input, inputs.earlier)[: 1 + self.layers.reads_history]:
            assert buffer.changes is not None
            marks = np.empty((buffer.images, buffer.height * buffer.width), np.bool_)
            cl.enqueue_copy(self._device.queue, marks, buffer.changes)
            shares.append(np.count_nonzero(np.logical_or.reduce(marks)) / marks.shape[1])
        return max(shares)


def _spread(changed: Tiles | None, size: tuple[int, int]) -> NDArray[np.uint8]:
    """The map of tiles to compute for a padded ``size``: changes spread since a pixel reads its right and lower neighbours.

    Its footprint depends on the left and upper ones, too; but if neither the pixel nor anything it reads has changed, its offset is 0.
    """
    rows, columns = (length // 4 for length in size)
    if changed is None:
        return np.ones((rows, columns), np.uint8)
    dirty = changed.copy()
    dirty[:, :-1] |= changed[:, 1:]
    dirty[:-1] |= dirty[1:].copy()
    return np.pad(dirty, ((0, rows - dirty.shape[0]), (0, columns - dirty.shape[1])), mode="edge").astype(np.uint8)
