# SPDX-License-Identifier: MIT
"""Run only the part of the network that changes reach (kernels/tile_list.cl, change_map.clh)."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.launch import enqueue
from stss_cl.device.parts import Parts, make_zeros
from stss_cl.network.layers import Layers
from stss_cl.network.tiles import TileList, find_tiles


class PartialNetwork:
    """The launches of ``layers``, which keep their outputs, over the tiles that changes of their inputs reach; on the same buffers."""

    def __init__(self, layers: Layers):
        assert layers.maps is not None
        device = layers.device
        self._layers, self._maps = layers, layers.maps
        self._counts = Parts(device, [4] * len(layers.launches))
        # A list is needed only until its layer is done, and layers run one after the other: one buffer is enough.
        numbers = make_zeros(device, 4 * max(launch.tiling.most for launch in layers.launches))
        lists = [TileList(numbers, count) for count in self._counts.buffers]
        pairs = list(zip(layers.launches, lists, strict=True))
        self._finders = [find_tiles(device, launch.tiling, launch.reads, to) for launch, to in pairs if launch.reads]
        self._launches = [launch.over(device, to) for launch, to in pairs]

    def load(self) -> None:
        """Let the runtime load or compile all kernels, by launches over empty lists and without marks."""
        self._clear()
        for launch in (*self._launches, *self._finders):
            launch.load(self._layers.device.queue)

    def run(self, image: cl.Buffer) -> None:
        """Enqueue the tiles that the marks in the change maps of ``inputs`` reach; the rest of ``image``, which is the last image, stays.

        The code that fills the network's inputs must mark the tiles that differ since the last run of ``layers`` or of this, and clear
        the marks after this one. The image has the same bits as one of ``layers``.
        """
        self._launches[-1].set(image=image)
        self._clear()
        pairs = zip(self._finders, self._launches, strict=True)
        enqueue(self._layers.device, (launch for pair in pairs for launch in pair))

    def _clear(self) -> None:
        self._maps.clear()
        self._counts.clear()

    def activity(self) -> NDArray[np.float32]:
        """The share of the stored activations that the last ``run`` changed, for each 4 x 4 pixels of the largest ones.

        Waits for the queue. A pixel of smaller activations counts for all pixels that it covers.
        """
        layers = self._layers
        height, width = layers.inputs.input.height, layers.inputs.input.width
        total, values = np.zeros((height, width), np.float32), 0.0
        for buffer in layers.marked:
            assert buffer.changes is not None
            changes = np.empty((buffer.images, buffer.rows - 2, buffer.columns - 2), np.uint8)
            cl.enqueue_copy(layers.device.queue, changes, buffer.changes)
            marks = changes.mean(axis=0)
            divisor = height // buffer.height
            share = buffer.images * buffer.channels / divisor**2
            total += share * marks.repeat(divisor, 0).repeat(divisor, 1)[:height, :width]
            values += share
        return (total / values).reshape(height // 4, 4, width // 4, 4).mean((1, 3), dtype=np.float32)
