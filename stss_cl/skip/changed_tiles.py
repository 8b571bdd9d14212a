# SPDX-License-Identifier: MIT
"""Launches that compute only the tiles that changes of their inputs reach (kernels/change_map.clh)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import ChangeMaps
from stss_cl.device.discovery import Device
from stss_cl.network.launch import Launch

EXACT = np.float32(-1)
"""The tolerance at which every bit counts."""


class ChangedTiles:
    """Launches that compute only what changed, made from those that compute everything, on the same buffers.

    Args:
        device: to run on.
        launches: all of them with ``skip``; the last one writes the image.
        maps: the change maps that they write.
    """

    def __init__(self, device: Device, launches: Iterable[Launch], maps: ChangeMaps):
        self._device, self._maps, self._tolerance = device, maps, EXACT
        self.launches = [_changed_tiles(device, launch) for launch in launches]

    def ready(self, image: cl.Buffer, tolerance: float) -> list[Launch]:
        """The launches in order, for maps that are clear."""
        chosen = np.float32(tolerance) if tolerance > 0 else EXACT
        if chosen != self._tolerance:
            self._tolerance = chosen
            for launch in self.launches:
                if "tolerance" in launch.arguments:
                    launch.set(tolerance=chosen)
        self.launches[-1].set(image=image)
        return self.launches

    def run(self, image: cl.Buffer, tolerance: float) -> None:
        """Enqueue them all; see ``stss_cl.skip.partial_network.PartialNetwork.run_changed``."""
        self._maps.clear()
        for launch in self.ready(image, tolerance):
            launch.enqueue(self._device.queue)
        self._device.queue.flush()


def _changed_tiles(device: Device, launch: Launch) -> Launch:
    skip = launch.skip
    assert skip is not None
    tolerance = {"tolerance": EXACT} if skip.bounded else {}
    return launch.skipping(device, {"SKIP": True}, {**skip.maps, **skip.numbers, **tolerance})
