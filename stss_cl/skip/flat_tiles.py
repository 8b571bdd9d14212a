# SPDX-License-Identifier: MIT
"""Flat tiles: where colour and surface are flat the decoder has next to nothing to add, and is not run (kernels/flat_tiles.cl)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.buffers import Inputs, map_bytes
from stss_cl.device.discovery import Device
from stss_cl.device.grid import GROUP, ceil_div, grid, list_size
from stss_cl.device.launch import Arguments, Launch, kernel
from stss_cl.device.parts import Counts, zeroed
from stss_cl.device.program import build
from stss_cl.network.layer import LayerLaunch
from stss_cl.network.tiles import Maps, TileList, find_tiles

DIVISORS = (1, 2, 4)
"""The decoder's sizes, as divisors of the frame's."""


class FlatTiles:
    """The network's layers, with the decoder's computing only the tiles that are not flat (*wanted*).

    Args:
        device: to run on.
        layers: the layers of the whole network; the last one writes the image.
        inputs: their inputs.
        mask: (height, width) uint8, 1 = not a hole of the newest frame, a buffer.
        size: height and width of the frame.
        flat: the largest second difference of a colour that counts as flat, in units of the image.
    """

    def __init__(
        self,
        device: Device,
        layers: Sequence[LayerLaunch],
        inputs: Inputs,
        mask: cl.Buffer,
        size: tuple[int, int],
        flat: float,
    ):
        self._device, self._size = device, size
        self._tiles = [(ceil_div(inputs.input.height // d, 4), ceil_div(inputs.input.width // d, 4)) for d in DIVISORS]
        self._maps = [zeroed(device, map_bytes(4 * rows, 4 * columns)) for rows, columns in self._tiles]
        marked, whole = zeroed(device, map_bytes(*(4 * n for n in self._tiles[0]))), self._tiles[0]
        self._apart = zeroed(device, 4 * whole[0] * whole[1])
        frame = {"height": size[0], "width": size[1]}
        given = {"gbuffer": inputs.base, "color": inputs.base, "mask": mask, "marked": marked}  # the first until ``read``
        self._detail = self._launch("detail", whole, {**given, **frame, "flat": flat})
        given = {"found": marked, "wanted": self._maps[0], "rows": whole[0], "columns": whole[1]}
        self._widened = self._launch("widened", whole, given)
        self._coarser = [
            self._launch("coarser", size, {"fine": fine, "out": out, "rows": size[0], "columns": size[1]})
            for fine, out, size in zip(self._maps, self._maps[1:], self._tiles, strict=False)
        ]
        given = {"wanted": self._maps[0], "color": inputs.base, "image": inputs.base, "apart": self._apart}
        self._departure = self._launch("departure", self._tiles[0], {**given, **frame})
        self._counts, self._finders = Counts(device, len(layers) + 1), list[Launch]()
        self._layers = list(self._replaced(layers))
        self._rest = self._upsampled(self._layers[-1])

    def read(self, gbuffer: cl.Buffer) -> None:
        """Use ``gbuffer`` (height, width, 9) as the frame's from now on; call this before the other methods."""
        self._detail.set(gbuffer=gbuffer)

    def ready(self, image: cl.Buffer) -> list[Launch]:
        """Enqueue the search for wanted tiles. Returns the layers in order, and a last launch that writes the rest of ``image``."""
        self._counts.clear()
        for launch in (self._detail, self._widened, *self._coarser, *self._finders):
            launch.enqueue(self._device.queue)
        self._layers[-1].set(image=image)
        self._rest.set(image=image)
        return [*self._layers, self._rest]

    def departure(self, image: cl.Buffer) -> float:
        """Largest difference of ``image``, made by the whole network, from the image without flat tiles; waits for it."""
        self._departure.set(image=image)
        for launch in (self._detail, self._widened, self._departure):
            launch.enqueue(self._device.queue)
        apart = np.empty(self._tiles[0], np.float32)
        cl.enqueue_copy(self._device.queue, apart, self._apart)
        return float(apart.max())

    def wanted(self) -> NDArray[np.bool_]:
        """True for the tiles that are not flat, (rows / 4, columns / 4) of the padded frame; waits for the queue."""
        return self.maps()[0]

    def maps(self) -> list[NDArray[np.bool_]]:
        """The same, and the decoder's maps at a half and a quarter of the size."""
        made = [np.empty(size, np.uint8) for size in self._tiles]
        for array, held in zip(made, self._maps, strict=True):
            cl.enqueue_copy(self._device.queue, array, held)
        return [array.astype(np.bool_) for array in made]

    def _launch(self, name: str, tiles: tuple[int, int], arguments: Arguments) -> Launch:
        made = kernel(build(self._device, "flat_tiles.cl"), name, arguments)
        return Launch(name, made, *grid(self._device, *tiles[::-1]), arguments)

    def _found(self, layer: LayerLaunch, size: int, reach: int, *, unmarked: bool = False) -> TileList:
        """The list of a layer's tiles within ``reach`` tiles of a wanted one, or with ``unmarked`` the others; made before each frame."""
        to = TileList(zeroed(self._device, 4 * layer.tiling.most), self._counts.take())
        wanted = Maps((self._maps[size],), *self._tiles[size])
        self._finders.append(find_tiles(self._device, layer.tiling.near(reach), wanted, to, unmarked=unmarked))
        return to

    def _replaced(self, layers: Sequence[LayerLaunch]) -> Iterator[LayerLaunch]:
        size = len(DIVISORS)
        for layer in layers:
            if layer.stage != "decoder":
                yield layer
                continue
            size -= layer.name == "upsample_corners"
            before_last = layer.name == "upsample_corners" or layer.name.endswith(".0")
            yield layer.over(self._device, self._found(layer, size, int(before_last)))

    def _upsampled(self, last: LayerLaunch) -> Launch:
        """The launch that writes the upsampled frame into flat tiles."""
        workers, group = (1, 1) if self._device.is_cpu else (16, GROUP)
        to = self._found(last, 0, 0, unmarked=True)
        names = "color", "image", "height", "width", "rows", "columns"
        arguments = {**{name: last.arguments[name] for name in names}, "tiles": to.tiles, "count": to.count}
        program = build(self._device, "decoder.cl", {"WORKERS": workers, "HALF": last.source.options["HALF"]})
        size = list_size(self._device, last.tiling.most, workers=workers, group=group)
        return Launch("upsampled", kernel(program, "upsampled", arguments), (size,), (group,), arguments)
