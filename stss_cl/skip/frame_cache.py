# SPDX-License-Identifier: MIT
"""What is kept of the last frame of a kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.discovery import Device
from stss_cl.image_space.frame_planes import Sources
from stss_cl.image_space.prepare import Prepare
from stss_cl.image_space.stages import Gather
from stss_cl.network.layers import Layers
from stss_cl.skip.error_control import RULES, Attention, ErrorControl
from stss_cl.skip.flat_tiles import FlatTiles
from stss_cl.skip.last_image import LastImage
from stss_cl.skip.partial_network import PartialNetwork
from stss_cl.skip.plan import InputPlan, Plan
from stss_cl.skip.uploaded_frames import Tiles

DECODER = 0.45
"""The decoder's share of the network's multiply-adds."""


@dataclass(frozen=True)
class Report:
    """What a frame cost.

    Attributes:
        prepared: share of the tiles of 4 x 4 pixels whose inputs were computed anew.
        changed: share of those whose inputs then differed; 1 where nobody looked.
        network: what of the network was run, see ``stss_cl.skip.plan.Plan``; ``none``: the frame is the last one of its kind.
        departure: for ``bounded``, of a frame that was checked: the largest difference that leaving out would have made.
    """

    prepared: float
    changed: float
    network: Literal["none", "changed", "partly", "whole"]
    departure: float | None = None


@dataclass(frozen=True)
class Last:
    """The last frame of a kind: its number and those of the oldest frame and of the colours that it read, and its ``valid``."""

    number: int
    oldest: int
    steps: tuple[int, ...]
    colors: tuple[int, ...]
    valid: NDArray[np.bool_]


class FrameCache:
    """All that is kept of the last frame of a kind. SF and EF differ at every silhouette: each would recompute the other's."""

    def __init__(self, device: Device, layers: Layers, gather: Gather, max_error: float, attention: Attention):
        self.layers, self.network = layers, PartialNetwork(layers)
        self.control = ErrorControl(max_error, attention)
        self.prepare = Prepare(device, *layers.size, gather, inputs=layers.inputs)
        self._max_bend = RULES.flat * max_error
        self._flat: FlatTiles | None = None
        self.last: Last | None = None
        self._is_first = True
        self._device = device
        height, width = layers.size
        self.image = LastImage(device, (2 * height, 2 * width, 3))
        self.network.begin()

    def read(self, steps: tuple[int, int, int]) -> tuple[int, ...]:
        """Those of the steps whose colour frames these weights read."""
        return steps if self.layers.reads_history else steps[:1]

    def prepare_inputs(self, sources: Sources, plan: InputPlan) -> float:
        """Fill the network's inputs; the share of tiles of which they then differ, 1 where nobody looked."""
        self._is_first, self.last = self.last is None, None  # should this end half-way, nothing of it is the next frame's
        self._mark(plan.dirty)
        self.prepare.start(sources, older=self.layers.reads_history, looking=plan.looking)
        self.prepare.strip()
        return 1.0 if self._is_first or not plan.looking else self._changed()

    def execute(self, plan: Plan) -> tuple[float | None, NDArray[np.bool_]]:
        """Run the network; the departure of a frame that is checked, and ``valid``."""
        departure = None
        if plan.network == "changed":
            self.network.run_changed(self.image.target(whole=False))
        else:
            target = self.image.target(whole=True)
            self.network.run(target, self._flat_tiles() if plan.network == "partly" else None)
            if plan.check:
                departure = self._flat_tiles().departure(target)
            self.network.expect_changes()
        valid = np.empty(self.layers.size, np.uint8)
        cl.enqueue_copy(self._device.queue, valid, self.prepare.mask)
        valid.flags.writeable = False
        return departure, valid.view(np.bool_)

    def activity(self) -> NDArray[np.float32]:
        """How much of the network ``run`` took, for each tile of the last frame: 1 but for flat tiles, which took no decoder."""
        return np.where(self._flat_tiles().wanted(), np.float32(1), np.float32(1 - DECODER))

    def _flat_tiles(self) -> FlatTiles:
        """Of the last frame prepared; built when it is first asked for."""
        if self._flat is None:
            layers = self.layers
            self._flat = FlatTiles(self._device, layers.launches, layers.inputs, self.prepare.mask, layers.size, self._max_bend)
        self._flat.read(self.prepare.gbuffer)
        return self._flat

    def _mark(self, dirty: Tiles | None) -> None:
        """Have the inputs computed where they are ``dirty``, and nowhere else; None: everywhere."""
        tiles = _spread(dirty, (self.prepare.rows, self.prepare.columns))
        cl.enqueue_copy(self._device.queue, self.prepare.dirty, tiles, is_blocking=True)

    def _changed(self) -> float:
        """The share of tiles whose inputs differ from the last ones; waits for them."""
        most = 0.0
        for buffer in (self.layers.inputs.input, self.layers.inputs.earlier):
            assert buffer.changes is not None
            marks = np.empty((buffer.images, buffer.changes.size // buffer.images), np.uint8)
            cl.enqueue_copy(self._device.queue, marks, buffer.changes)
            most = max(most, np.count_nonzero(marks.any(axis=0)) / marks.shape[1])
        return most


def _spread(changed: Tiles | None, size: tuple[int, int]) -> NDArray[np.uint8]:
    """The map of what is to be computed for a padded ``size``: a pixel reads its right and lower neighbours, and padding repeats."""
    rows, columns = (length // 4 for length in size)
    if changed is None:
        return np.ones((rows, columns), np.uint8)
    dirty = changed.copy()
    dirty[:, :-1] |= changed[:, 1:]
    dirty[:-1] |= dirty[1:].copy()
    return np.pad(dirty, ((0, rows - dirty.shape[0]), (0, columns - dirty.shape[1])), mode="edge").astype(np.uint8)
