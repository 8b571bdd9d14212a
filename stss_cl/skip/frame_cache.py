# SPDX-License-Identifier: MIT
"""The data kept of the last frame of a kind, SF or EF, from which the next one is computed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.discovery import Device
from stss_cl.device.staging import staging
from stss_cl.image_space.frame_planes import Sources
from stss_cl.image_space.prepare import Prepare
from stss_cl.image_space.stages import Gather
from stss_cl.network.layers import Layers
from stss_cl.skip.arrival import Tiles
from stss_cl.skip.error_control import RULES, Attention, ErrorControl
from stss_cl.skip.flat_tiles import FlatTiles
from stss_cl.skip.last_image import LastImage
from stss_cl.skip.partial_network import PartialNetwork
from stss_cl.skip.plan import InputPlan, Plan

DECODER = 0.45
"""The decoder's share of the network's multiply-adds."""


@dataclass(frozen=True)
class Report:
    """The cost of a frame.

    Attributes:
        prepared: share of the tiles of 4 x 4 pixels whose inputs were computed anew.
        changed: share of the tiles whose inputs then differed; 1 if they were not compared.
        network: the part of the network that ran, see ``stss_cl.skip.plan.Plan``; ``none``: the frame equals the last one of its kind.
        departure: for ``bounded``, if the frame was checked: the largest error that leaving out flat tiles would have made.
    """

    prepared: float
    changed: float
    network: Literal["none", "changed", "partly", "whole"]
    departure: float | None = None


@dataclass(frozen=True)
class Last:
    """The last frame of a kind: its number, the numbers of the oldest frame and of the colours that it read, and ``valid`` or None."""

    number: int
    oldest: int
    steps: tuple[int, ...]
    colors: tuple[int, ...]
    valid: NDArray[np.bool_] | None


class FrameCache:
    """The data kept of the last frame of a kind. SF and EF have separate caches, since their inputs differ at every silhouette."""

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
        """The steps whose colour frames these weights read."""
        return steps if self.layers.reads_history else steps[:1]

    def prepare_inputs(self, sources: Sources, plan: InputPlan) -> float:
        """Fill the network's inputs; returns the share of tiles in which they then differ, 1 if they were not compared."""
        self._is_first, self.last = self.last is None, None  # if this fails half-way, the next frame must not use it
        self._mark(plan.dirty)
        self.prepare.start(sources, older=self.layers.reads_history, looking=plan.looking)
        self.prepare.strip()
        return 1.0 if self._is_first or not plan.looking else self._changed()

    def execute(self, plan: Plan) -> float | None:
        """Run the network; returns the departure if the frame is checked, else None."""
        departure = None
        if plan.network == "changed":
            self.network.run_changed(self.image.target(whole=False))
        else:
            target = self.image.target(whole=True)
            self.network.run(target, self._flat_tiles() if plan.network == "partly" else None)
            if plan.check:
                departure = self._flat_tiles().departure(target)
            self.network.expect_changes()
        return departure

    def activity(self) -> NDArray[np.float32]:
        """The share of the network that ran for each tile of the last frame: 1, or less in flat tiles, which need no decoder."""
        return np.where(self._flat_tiles().wanted(), np.float32(1), np.float32(1 - DECODER))

    def _flat_tiles(self) -> FlatTiles:
        """The flat tiles of the last frame prepared; built at its first use."""
        if self._flat is None:
            layers = self.layers
            self._flat = FlatTiles(self._device, layers.launches, layers.inputs, self.prepare.mask, layers.size, self._max_bend)
        self._flat.read(self.prepare.gbuffer)
        return self._flat

    def _mark(self, dirty: Tiles | None) -> None:
        """Mark where the inputs are to be computed: where they are ``dirty``, or everywhere for None."""
        tiles = _spread(dirty, (self.prepare.rows, self.prepare.columns))
        if self._device.is_cpu:
            cl.enqueue_copy(self._device.queue, self.prepare.dirty, tiles, is_blocking=True)
        else:
            staging(self._device).write(self.prepare.dirty, tiles)

    def _changed(self) -> float:
        """The share of tiles whose inputs differ from the last ones; waits for them."""
        assert self.layers.inputs.changes is not None
        now, earlier, _ = self.layers.inputs.changes.read()
        return float(max(np.mean(now != 0), np.mean(earlier.reshape(3, -1).any(axis=0))))


def _spread(changed: Tiles | None, size: tuple[int, int]) -> NDArray[np.uint8]:
    """The map of tiles to compute for a padded ``size``: changes spread since a pixel reads its right and lower neighbours."""
    rows, columns = (length // 4 for length in size)
    if changed is None:
        return np.ones((rows, columns), np.uint8)
    dirty = changed.copy()
    dirty[:, :-1] |= changed[:, 1:]
    dirty[:-1] |= dirty[1:].copy()
    return np.pad(dirty, ((0, rows - dirty.shape[0]), (0, columns - dirty.shape[1])), mode="edge").astype(np.uint8)
