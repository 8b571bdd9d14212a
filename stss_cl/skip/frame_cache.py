# SPDX-License-Identifier: MIT
"""What is kept of the last frame of a kind."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.buffers import Outgoing
from stss_cl.device.discovery import Device
from stss_cl.image_space.prepare import Prepare
from stss_cl.image_space.stages import Gather
from stss_cl.network.layers import Layers
from stss_cl.skip.error_control import FIRST, GROWTH, Depth, Shot
from stss_cl.skip.flat_tiles import FlatTiles
from stss_cl.skip.partial_network import Level, PartialNetwork

FLAT = 0.5
"""``bounded``: the largest second difference of a colour that counts as flat, as a share of the largest error."""
DECODER = 0.45
"""The decoder's share of the network's multiply-adds."""
CHECK = 12
"""``bounded``: one of so many frames of a kind of which something was left out is computed both ways; at first one of two, then of four."""

ROWS = 32
"""Of an image, compared at a time."""


@dataclass(frozen=True)
class Report:
    """What a frame cost.

    Attributes:
        prepared: share of the tiles of 4 x 4 pixels whose inputs were computed anew.
        changed: share of those whose inputs then differed; 1 where nobody looked.
        network: what of the network was run; ``partly``: everywhere, but for what may be left out (``stss_cl.skip.error_control``).
        departure: for ``bounded``, of a frame that was checked: the largest difference that leaving out made.
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


class Choice(NamedTuple):
    """What is left out of a frame, and whether it is ``due`` to be checked."""

    level: Level
    due: bool

    @property
    def older(self) -> bool:
        """Whether the two older colour frames are read, by weights that read them."""
        return self.level.history or self.due


def distance(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """The largest difference of two images; some rows at a time, so that nothing of an image's size is made for it."""
    return max(float(np.abs(a[y : y + ROWS] - b[y : y + ROWS]).max()) for y in range(0, len(a), ROWS))


class FrameCache:
    """All that is kept of the last frame of a kind. SF and EF differ at every silhouette: each would recompute the other's."""

    def __init__(self, device: Device, layers: Layers, gather: Gather, max_error: float):
        self.layers, self.network = layers, PartialNetwork(layers)
        self.stale = False
        self._depth, self._shot = Depth(len(self.network.levels) - 1 if max_error else 0, max_error), Shot()
        self.prepare = Prepare(device, *layers.size, gather, inputs=layers.inputs)
        self._max_bend = FLAT * max_error
        self._flat: FlatTiles | None = None
        self.last: Last | None = None
        self._device = device
        self._unchecked, self._period = 0, FIRST
        self._image: Outgoing | None = None
        self._alone = 0
        self.network.begin()

    def read(self, steps: tuple[int, int, int]) -> tuple[int, ...]:
        """Those of the steps whose colour frames these weights read."""
        return steps if self.layers.reads_history else steps[:1]

    @property
    def image(self) -> NDArray[np.float32]:
        """The last image, not to be written to."""
        assert self._image is not None
        shown = self._image.finish().view()
        shown.flags.writeable = False
        return shown

    def target(self, *, whole: bool) -> cl.Buffer:
        """Where to write the image: over the last one; over a copy of it if somebody still has that, or a new one if ``whole``."""
        last = self._image
        if last is None or sys.getrefcount(last.array) > self._alone:
            height, width = self.layers.size
            self._image = Outgoing(self._device, (2 * height, 2 * width, 3), on_device=False)
            self._alone = sys.getrefcount(self._image.array)
            if last is not None and not whole:
                cl.enqueue_copy(self._device.queue, self._image.data, last.data)
        assert self._image is not None
        return self._image.data

    def choose(self, color: NDArray[np.float32] | None) -> Choice:
        """What of the network a frame takes in which nearly everything changed.

        Args:
            color: the newest (H, W, 3), by which another shot is told; None: nothing may be left out.
        """
        if color is None or self._shot.cut(color):
            self._depth.fresh()
            return Choice(self.network.levels[0], due=False)
        level, due = self._depth.next()
        return Choice(self.network.levels[level], due)

    def run(self, choice: Choice) -> float | None:
        """Run the network everywhere but for what is left out; the departure that this made, if the frame was due."""
        level, whole, target = choice.level, self.network.levels[0], self.target(whole=True)
        self.stale = level != whole and not choice.due
        if choice.due and level.stays == whole.stays:  # nothing old: what flat tiles lack can be seen in the whole image
            self.network.run(target, whole)
            departure = self._flat_tiles().departure(target)
        else:
            self.network.run(target, level, self._flat_tiles() if level.flat else None)
            if not choice.due:
                return None
            left_out = self.image  # while it is held, the next image is another one
            self.network.complete(self.target(whole=True), level)
            departure = distance(self.image, left_out)
        self._depth.judge(departure)
        return departure

    def is_due(self) -> bool:
        """Count a frame of which tolerances may have kept something; whether it is to be computed both ways."""
        self._unchecked += 1
        return self._unchecked >= self._period

    def checked(self, *, well: bool) -> None:
        """It was; the next ones are farther apart if it went well."""
        self._unchecked, self._period = 0, min(GROWTH * self._period, CHECK) if well else FIRST

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

    def changed(self) -> float:
        """The share of tiles whose inputs differ from the last ones; waits for them."""
        most = 0.0
        for buffer in (self.layers.inputs.input, self.layers.inputs.earlier):
            assert buffer.changes is not None
            marks = np.empty((buffer.images, buffer.changes.size // buffer.images), np.uint8)
            cl.enqueue_copy(self._device.queue, marks, buffer.changes)
            most = max(most, np.count_nonzero(marks.any(axis=0)) / marks.shape[1])
        return most
