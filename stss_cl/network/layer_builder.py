# SPDX-License-Identifier: MIT
"""Build a sequence of launches with the buffers between them; ``stss_cl.network.layers`` builds the network with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stss_cl.device.buffers import BFLOAT16, FeatureMap, Inputs, map_bytes, pad
from stss_cl.device.conversion import storage_options
from stss_cl.device.discovery import Device
from stss_cl.device.grid import GROUP, list_size
from stss_cl.device.launch import Arguments
from stss_cl.device.parts import Parts
from stss_cl.network.conv import ConvSpec, Final, conv
from stss_cl.network.layer import FAST, KernelSource, LayerLaunch, Work, layer
from stss_cl.network.pack_weights import pack
from stss_cl.network.plan import Conv, Slot
from stss_cl.network.tiles import Maps, Tiling
from stss_ref.weights import Tensors


class LayerBuilder:
    """Makes layers on the buffers of a plan, in order.

    Args:
        device: to run on.
        weights: the tensors of the plan's layers.
        precision: see ``stss_cl.options.PRECISIONS``.
        slots: the plan's buffers.
        inputs: the first of these buffers; the others have change maps if these have.

    Attributes:
        launches: in order, those of ``once`` first.
        marked: the buffers with change maps, without the inputs.
        maps: their change maps; None: there are none.
        results: the place of each launch's result: buffer, first channel, channels; None: it leaves no whole layer's result.
    """

    def __init__(self, device: Device, weights: Tensors, precision: str, slots: Sequence[Slot], inputs: Inputs):
        self.launches: list[LayerLaunch] = []
        self.results: list[tuple[FeatureMap, int, int] | None] = []
        full = inputs.input
        self._device, self._weights, self._dtype = device, weights, full.dtype
        self._winograd = precision != "float32-direct"
        first = full, inputs.earlier, inputs.eighth
        tensors = [
            pad(device, full.height // slot.divisor, full.width // slot.divisor, slot.channels, full.dtype, slot.images)
            for slot in slots[len(first) :]
        ]
        keep = inputs.changes is not None
        self.maps = Parts(device, [map_bytes(each.height, each.width, each.images) for each in tensors]) if keep else None
        self.marked = (
            [replace(each, changes=part) for each, part in zip(tensors, self.maps.buffers, strict=True)] if self.maps else []
        )
        self._tensors = dict(zip(slots, (*first, *(self.marked or tensors)), strict=True))

    def __getitem__(self, slot: Slot) -> FeatureMap:
        return self._tensors[slot]

    def conv(self, step: Conv, final: Final | None = None) -> None:
        """Append a convolution; ``final``: it writes the image, not its output."""
        layer, a, out = step.layer, self[step.inputs[0][0]], self[step.out]
        b = self[step.inputs[1][0]] if len(step.inputs) > 1 else None
        # At an eighth of the size a tile of 4 x 4 would be 32 pixels of the frame, and rounding spreads by a tile in each layer: decision
        # 11.
        side = 0 if not self._winograd else 2 if layer.divisor == 8 else 4
        packed = pack(self._weights, layer.name, tuple((real, slot.channels) for slot, real in step.inputs))
        spec = ConvSpec(layer.stage, layer.name, packed, layer.stride, layer.relu, side)
        launch = conv(self._device, spec, a, b, out, out_first=step.first, image=step.image, final=final)
        self.launches.append(launch)
        self.results.append((out, step.first, layer.outputs) if final is None else None)

    def kernel(
        self,
        stage: str,
        source: KernelSource,
        arguments: Arguments,
        tiling: Tiling,
        *,
        workers: int = 16,
        reads: tuple[FeatureMap, ...],
        out: FeatureMap | None,
    ) -> LayerLaunch:
        """Append any other kernel over tiles; the list of its tiles is added to ``arguments``.

        Args:
            stage: of the layer, whose name is the kernel's.
            source: the kernel, without the options that all have.
            arguments: the kernel's, by name.
            tiling: the tiles of its output.
            workers: work-items that share a tile on a GPU.
            reads: the inputs that have change maps.
            out: the activations that it writes and marks; None: it writes the image.
        """
        # Interpolation is not contracted, so that it has the reference's bits.
        flags = FAST if stage == "erm" else ""
        workers = 1 if self._device.is_cpu else workers
        options = {**source.options, "WORKERS": workers, **storage_options(self._device, self._dtype)}
        source = KernelSource(source.file, source.kernel, options, flags)
        group = 1 if self._device.is_cpu else max(GROUP, workers)
        size = list_size(self._device, tiling.most, workers=workers, group=group)
        maps = tuple(tensor.changes for tensor in reads if tensor.changes is not None)
        maps_in = Maps(maps, reads[0].rows - 2, reads[0].columns - 2) if maps else None
        work = Work(tiling, (size,), (group,))
        self.launches.append(layer(self._device, stage, source.kernel, source, arguments, work, maps_in, out))
        self.results.append(None)
        return self.launches[-1]


def dtype_of(precision: str) -> np.dtype[Any]:
    """The dtype in which activations are stored."""
    return {"half": np.dtype(np.float16), "bfloat16": BFLOAT16}.get(precision, np.dtype(np.float32))
