# SPDX-License-Identifier: MIT
"""Layers that compute only the tiles that changes of their inputs reach (kernels/tile_list.cl, change_map.clh)."""

from __future__ import annotations

from collections.abc import Sequence

import pyopencl as cl

from stss_cl.device.discovery import Device
from stss_cl.device.launch import enqueue
from stss_cl.device.parts import Parts, make_zeros
from stss_cl.network.layer import LayerLaunch
from stss_cl.network.tiles import TileList, find_tiles


class ChangedTiles:
    """Layers that compute only changed tiles, made from layers that compute all tiles, on the same buffers.

    Args:
        device: to run on.
        layers: layers with change maps; the last one writes the image.
        maps: the change maps that they write.

    Attributes:
        layers: the layers that compute only changed tiles.
    """

    def __init__(self, device: Device, layers: Sequence[LayerLaunch], maps: Parts):
        self._device, self._maps = device, maps
        self._counts = Parts(device, [4] * len(layers))
        # A list is needed only until its layer is done, and layers run one after the other: one buffer is enough.
        numbers = make_zeros(device, 4 * max(layer.tiling.most for layer in layers))
        lists = [TileList(numbers, count) for count in self._counts.buffers]
        self._finders = [
            find_tiles(device, layer.tiling, layer.reads, to) for layer, to in zip(layers, lists, strict=True) if layer.reads
        ]
        self.layers = [layer.over(device, to) for layer, to in zip(layers, lists, strict=True)]

    def load(self) -> None:
        """Let the runtime load or compile all kernels, by launches over empty lists and without marks."""
        self._maps.clear()
        self._counts.clear()
        for launch in (*self.layers, *self._finders):
            launch.load(self._device.queue)

    def run(self, image: cl.Buffer) -> None:
        """Enqueue all layers; see ``stss_cl.skip.partial_network.PartialNetwork.run_changed``."""
        self.layers[-1].set(image=image)
        self._maps.clear()
        self._counts.clear()
        pairs = zip(self._finders, self.layers, strict=True)
        enqueue(self._device, (launch for pair in pairs for launch in pair))
