# SPDX-License-Identifier: MIT
"""Build a sequence of launches with the buffers between them; ``stss_cl.network.layers`` builds the network with it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from stss_cl.device.buffers import ChangeMaps, Padded, padded
from stss_cl.device.discovery import Device
from stss_cl.device.grid import GROUP, list_size
from stss_cl.device.launch import Arguments
from stss_cl.network.conv import Final, conv, half
from stss_cl.network.layer import FAST_MULTIPLY_ADD, KernelSource, LayerLaunch, layer
from stss_cl.network.pack_weights import pack
from stss_cl.network.tiles import Maps, Tiling
from stss_ref.weights import LAYERS, Weights

OUTPUTS = {layer.name: layer.outputs for layer in LAYERS}


class LayerBuilder:
    """Appends layers in order.

    Args:
        device: to run on.
        weights: the 92 tensors.
        precision: see ``stss_cl.network.network.PRECISIONS``.
        height, width: of the largest activations, multiples of 8.
        keep: every layer has a buffer of its own, with a change map.

    Attributes:
        launches: in order.
        marked: the buffers with change maps, likewise.
        maps: their change maps.
        results: what each launch leaves as the layer's result: buffer, first channel, channels; None: no more than others read.
        dtype: of the activations.
    """

    def __init__(self, device: Device, weights: Weights, precision: str, height: int, width: int, keep: bool):
        self.launches: list[LayerLaunch] = []
        self.marked: list[Padded] = []
        self.results: list[tuple[Padded, int, int] | None] = []
        self.maps = ChangeMaps(device, height, width)
        self.dtype = dtype_of(precision)
        self._device, self._weights, self._keep = device, weights, keep
        self._winograd = precision != "float32-direct"
        self._height, self._width = height, width
        self._shared: dict[tuple[str, int, int], Padded] = {}

    def padded(self, divisor: int, channels: int, images: int = 1) -> Padded:
        """Activations of 1 / ``divisor`` of the size."""
        height, width = self._height // divisor, self._width // divisor
        made = padded(self._device, height, width, channels, self.dtype, images)
        if not self._keep:
            return made
        self.marked.append(replace(made, changes=self.maps.take(height, width, images)))
        return self.marked[-1]

    def share(self, name: str, divisor: int, buffer: Padded) -> None:
        """Let ``scratch`` return ``buffer`` for this name and size, unless all buffers are kept."""
        self._shared[name, divisor, buffer.channels] = buffer

    def scratch(self, name: str, divisor: int, channels: int, images: int = 1) -> Padded:
        """Activations for short use: the same buffer for the same name and size, or a new one each time if all are kept."""
        key = name if images == 1 else f"{name} of {images}", divisor, channels
        if self._keep or key not in self._shared:
            self._shared[key] = self.padded(divisor, channels, images)
        return self._shared[key]

    def conv(
        self,
        stage: str,
        name: str,
        a: Padded,
        out: Padded,
        *,
        b: Padded | None = None,
        channels: tuple[int, ...] | None = None,
        stride: int = 1,
        relu: bool = True,
        out_first: int = 0,
        image: int | None = 0,
        final: Final | None = None,
    ) -> Padded:
        """Append a convolution; ``channels``: how many of each input's are real, where not all."""
        held = (a,) if b is None else (a, b)
        # At an eighth a tile of 4 x 4 would be 32 pixels of the frame, and rounding spreads by a tile a layer: decision 21.
        side = 0 if not self._winograd else 2 if out.height * 8 == self._height else 4
        real = channels or tuple(x.channels for x in held)
        packed = pack(self._weights, name, tuple((n, x.channels) for n, x in zip(real, held, strict=True)))
        launch = conv(
            self._device, stage, name, packed, a, b, out,
            out_first=out_first, stride=stride, relu=relu, side=side, image=image, final=final,
        )  # fmt: skip
        self.launches.append(launch)
        self.results.append((out, out_first, OUTPUTS[name]) if final is None else None)
        return out

    def kernel(
        self,
        stage: str,
        name: str,
        file: str,
        options: dict[str, object],
        arguments: Arguments,
        tiling: Tiling,
        *,
        workers: int = 16,
        reads: tuple[Padded, ...],
        out: Padded | None,
    ) -> LayerLaunch:
        """Append any other kernel over tiles; its tile list comes after ``arguments``.

        Args:
            stage, name: of the layer; the kernel has the same name.
            file: the kernel's file.
            options: its build options.
            arguments: its own arguments.
            tiling: the tiles of its output.
            workers: work-items that share a tile on a GPU.
            reads: the inputs that have change maps.
            out: the activations that it writes and marks; None: it writes the image.
        """
        # Interpolation is not contracted, so that it has the reference's bits.
        flags = FAST_MULTIPLY_ADD if stage == "erm" else ""
        workers = 1 if self._device.is_cpu else workers
        source = KernelSource(file, name, {**options, "WORKERS": workers, "HALF": half(self.dtype)}, flags)
        group = 1 if self._device.is_cpu else max(GROUP, workers)
        size = list_size(self._device, tiling.most, workers=workers, group=group)
        maps = tuple(held.changes for held in reads if held.changes is not None)
        known = Maps(maps, -(-reads[0].height // 4), -(-reads[0].width // 4)) if maps else None
        self.launches.append(layer(self._device, stage, name, source, arguments, tiling, (size,), (group,), known, out))
        self.results.append(None)
        return self.launches[-1]


def dtype_of(precision: str) -> np.dtype[Any]:
    """The dtype in which activations are stored."""
    return np.dtype(np.float16 if precision == "half" else np.float32)
