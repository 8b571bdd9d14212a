# SPDX-License-Identifier: MIT
"""A network of which less than all is run: where something changed, without flat tiles, or without layers that may be old."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.launch import enqueue
from stss_cl.network.layer import Layer
from stss_cl.network.layers import Layers
from stss_cl.skip.changed_tiles import ChangedTiles
from stss_cl.skip.flat_tiles import FlatTiles


class Level(NamedTuple):
    """What is left out of a frame.

    Attributes:
        stays: launches that are left out, as positions among all, so that what they made stays as it is.
        flat: whether the decoder's flat tiles are (``stss_cl.skip.flat_tiles``).
        history: whether the history is read.
    """

    stays: frozenset[int]
    flat: bool
    history: bool


WHOLE = Level(frozenset(), flat=False, history=True)


def levels(launches: Sequence[Layer], reads_history: bool) -> tuple[Level, ...]:
    """What may be left out, each more than the one before.

    Nothing, but for the history if these weights do not read it; flat tiles; the history; with it the ERM and the encoder's eighth
    size; with them all of the quarter size.
    """

    def where(*names: str, stage: str = "") -> frozenset[int]:
        return frozenset(i for i, launch in enumerate(launches) if launch.stage == stage or launch.name.startswith(names))

    history = where(stage="history")
    if not history:
        return (WHOLE,)
    eighth = history | where("down3.", stage="erm")
    first = min(where("up1."))
    quarter = eighth | where("down2.", "up1.") | {first - 1}  # the upsampling before up1
    stays = [frozenset[int](), history, eighth, quarter][not reads_history :]
    return tuple(
        Level(which, flat, history=not which)
        for which, flat in zip(stays[:1] + stays, (False, *len(stays) * [True]), strict=True)
    )


class PartialNetwork:
    """The network of ``layers``, of which every layer keeps what it wrote; other layers are always run whole."""

    def __init__(self, layers: Layers):
        self.layers = layers
        self.levels = levels(layers.launches, layers.reads_history) if layers.keep else (WHOLE,)

    def begin(self) -> None:
        """Enqueue, before the first ``run``, what no later one computes again."""
        enqueue(self.layers.device, (launch for i, launch in enumerate(self.layers.launches) if i in self.levels[0].stays))

    def run(self, image: cl.Buffer, level: Level = WHOLE, flat: FlatTiles | None = None) -> None:
        """Enqueue the network but for what is left out at ``level``; ``image`` is complete when the queue has run dry.

        ``flat`` is what leaves flat tiles out.
        """
        assert flat is not None or not level.flat
        launches = flat.ready(image) if flat is not None and level.flat else self.layers.ready(image)
        enqueue(self.layers.device, (launch for i, launch in enumerate(launches) if i not in level.stays))

    def complete(self, image: cl.Buffer, level: Level) -> None:
        """After ``run`` at ``level``: enqueue what was left out, and what is made of it. The same bits as ``run`` of the whole."""
        stayed, reads_it = level.stays - self.levels[0].stays, "" if level == self.levels[0] else "decoder"
        launches = enumerate(self.layers.ready(image))
        enqueue(self.layers.device, (launch for i, launch in launches if i in stayed or launch.stage == reads_it))

    def run_changed(self, image: cl.Buffer, tolerance: float = 0.0) -> None:
        """Enqueue what the marks in the change maps of ``inputs`` lead to; the rest of ``image``, the last one made, stays.

        Whoever fills the network's inputs marks the tiles that came to differ since the last run of either kind, and clears the
        marks behind this one.

        Args:
            image: as for ``run``.
            tolerance: a stored value between two layers that is no further than this from the new one stays; 0: the image has
                the bits of ``run``'s, if all runs since the last of those had 0.
        """
        self._changed_tiles.run(image, tolerance)

    def expect_changes(self) -> None:
        """Build what the first ``run_changed`` would wait for."""
        _ = self._changed_tiles

    @cached_property
    def _changed_tiles(self) -> ChangedTiles:
        launches = [launch for i, launch in enumerate(self.layers.launches) if i not in self.levels[0].stays]
        return ChangedTiles(self.layers.device, launches, self.layers.maps)

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
