# SPDX-License-Identifier: MIT
"""Run the network, or only the part of it that changes reach."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.network.layers import Layers
from stss_cl.skip.changed_tiles import ChangedTiles


class PartialNetwork:
    """Runs the network of ``layers``, which keep their outputs, whole or in part."""

    def __init__(self, layers: Layers):
        assert layers.maps is not None
        self.layers = layers
        self._changed = ChangedTiles(layers.device, layers.launches, layers.maps)

    def load(self) -> None:
        """Let the runtime load or compile all kernels."""
        self.layers.load()
        self._changed.load()

    def run(self, image: cl.Buffer) -> None:
        """Enqueue the whole network; ``image`` is complete when the queue is empty."""
        self.layers.run(image)

    def run_changed(self, image: cl.Buffer) -> None:
        """Enqueue the tiles that the marks in the change maps of ``inputs`` reach; the rest of ``image``, which is the last image, stays.

        The code that fills the network's inputs must mark the tiles that differ since the last ``run`` or ``run_changed``, and clear
        the marks after this one. The image has the same bits as one of ``run``.
        """
        self._changed.run(image)

    def activity(self) -> NDArray[np.float32]:
        """The share of the stored activations that the last ``run_changed`` changed, for each 4 x 4 pixels of the largest ones.

        Waits for the queue. A pixel of smaller activations counts for all pixels that it covers.
        """
        layers = self.layers
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
