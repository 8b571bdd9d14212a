# SPDX-License-Identifier: MIT
"""A network of which less than all is run: where something changed, or without flat tiles."""

from __future__ import annotations

from contextlib import suppress
from threading import Thread

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.launch import enqueue
from stss_cl.network.layer import LayerLaunch
from stss_cl.network.layers import Layers
from stss_cl.network.tiles import finder
from stss_cl.skip.changed_tiles import ChangedTiles
from stss_cl.skip.flat_tiles import FlatTiles


class PartialNetwork:
    """The network of ``layers``, of which every layer keeps what it wrote; other layers are always run whole."""

    def __init__(self, layers: Layers):
        self.layers = layers
        self._changed: ChangedTiles | None = None
        self._builder: Thread | None = None
        # What no frame changes: by weights that do not read the history, what its branch makes.
        constant = layers.keep and not layers.reads_history
        self._constant = frozenset(i for i, layer in enumerate(layers.launches) if constant and layer.stage == "history")

    def begin(self) -> None:
        """Enqueue, before the first ``run``, what no later one computes again."""
        enqueue(self.layers.device, (layer for i, layer in enumerate(self.layers.launches) if i in self._constant))

    def run(self, image: cl.Buffer, flat: FlatTiles | None = None) -> None:
        """Enqueue the network, without what is ``flat``; ``image`` is complete when the queue has run dry."""
        launches = self.layers.ready(image) if flat is None else flat.ready(image)
        enqueue(self.layers.device, (launch for i, launch in enumerate(launches) if i not in self._constant))

    def run_changed(self, image: cl.Buffer) -> None:
        """Enqueue what the marks in the change maps of ``inputs`` lead to; the rest of ``image``, the last one made, stays.

        Whoever fills the network's inputs marks the tiles that came to differ since the last run of either kind, and clears the
        marks behind this one. The image has the bits of ``run``'s.
        """
        self.changed_tiles().run(image)

    def expect_changes(self) -> None:
        """Begin to build what the first ``run_changed`` would wait for, while the caller does something else with its image."""
        if self._changed is None and self._builder is None:
            self._builder = Thread(target=self._build_behind)
            self._builder.start()

    def settle(self) -> None:
        """Wait for it, and load it: better at a stream's start than among its frames."""
        if self._builder is not None:
            self._builder.join()
            self._builder = None
            self.changed_tiles()

    def changed_tiles(self) -> ChangedTiles:
        """What ``run_changed`` runs; made once."""
        if self._changed is None:
            self._changed = ChangedTiles(self.layers.device, self._layers(), self.layers.maps)
        return self._changed

    def _build_behind(self) -> None:
        # Programs alone: PyOpenCL writes code for each kernel object, and warns where two threads do so at once.
        with suppress(Exception):  # whatever it is, ``run_changed`` meets it, too
            finder(self.layers.device)
            for layer in self._layers():
                layer.program(self.layers.device, marking=layer.changes is not None)

    def _layers(self) -> list[LayerLaunch]:
        return [layer for i, layer in enumerate(self.layers.launches) if i not in self._constant]

    def activity(self) -> NDArray[np.float32]:
        """Where the last ``run_changed`` changed anything: the share of the stored activations, for each 4 x 4 pixels of the largest.

        Waits for the queue. A tile of smaller activations counts for all the pixels that it stands for.
        """
        layers = self.layers
        height, width = layers.inputs.input.height, layers.inputs.input.width
        total, values = np.zeros((height // 4, width // 4), np.float32), 0.0
        for buffer in layers.marked:
            assert buffer.changes is not None
            marks = np.empty((-(-buffer.height // 4), -(-buffer.width // 4)), np.uint8)
            cl.enqueue_copy(layers.device.queue, marks, buffer.changes)
            divisor = height // buffer.height
            share = buffer.channels / divisor**2
            total += share * marks.repeat(divisor, 0).repeat(divisor, 1)[: height // 4, : width // 4]
            values += share
        return (total / values).astype(np.float32)
