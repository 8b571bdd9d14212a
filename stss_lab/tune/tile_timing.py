# SPDX-License-Identifier: MIT
"""Time layers like the network's with given tile sizes, after comparing their results with the plain kernel's."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pyopencl as cl

from conformance.tolerance import ratio
from stss_cl.device.buffers import pad, read, write
from stss_cl.device.discovery import Device, Properties
from stss_cl.device.grid import ceil8
from stss_cl.device.launch import Launch
from stss_cl.device.tuning import Direct, Local, Tuning, Winograd, trial
from stss_cl.network.conv import ConvSpec, conv
from stss_cl.network.pack_weights import PackedLayer, pack
from stss_ground.errors import DeviceError
from stss_ref.arrays import Array

MIN_DURATION = 2e-3
"""Least duration of one timing, reached by repetition; seconds."""
CHECK_SIZE = (45, 75)
"""Output size (H, W) at which a candidate is compared with the plain kernel: no tile size divides it, and it has several strips."""
PLAIN = Direct(1, 1, 1)
INTEL = "Intel(R) OpenCL:"
"""Intel's compiler takes minutes for one kernel of half storage with vectors of 16, and a row holds for all precisions."""

Sizes = Winograd | Direct | Local


@dataclass(frozen=True)
class LayerShape:
    """The shape of some layers of the network: channels of both inputs and of the output; the output is 1 / ``divisor`` of the frame.

    ``count`` is the number of such layers.
    """

    a: int
    b: int
    outputs: int
    gated: bool
    stride: int
    divisor: int
    count: float

    @property
    def fast(self) -> bool:
        """Whether winograd.cl can compute it."""
        return self.a % 8 == 0


SHAPES = (
    LayerShape(24, 0, 24, True, 1, 1, 2.5),
    LayerShape(24, 0, 24, False, 1, 2, 10),
    LayerShape(24, 24, 24, False, 1, 1, 1),
    LayerShape(32, 0, 24, False, 1, 2, 1),
    LayerShape(24, 0, 24, True, 2, 2, 1.25),
    LayerShape(4, 0, 24, False, 2, 2, 3),
    LayerShape(24, 32, 32, False, 1, 2, 1),
    LayerShape(32, 0, 32, False, 1, 4, 8),
    LayerShape(32, 0, 32, True, 1, 4, 2.5),
    LayerShape(64, 0, 32, False, 1, 4, 1),
    LayerShape(24, 0, 32, False, 2, 4, 3),
    LayerShape(32, 0, 32, True, 2, 8, 1),
    LayerShape(32, 0, 32, False, 2, 8, 3),
    LayerShape(32, 96, 64, False, 1, 4, 1),
    LayerShape(64, 0, 64, False, 1, 8, 3),
)


@dataclass
class Trials:
    """Timings: seconds by shape and candidate, and the reason why a candidate was refused."""

    times: dict[LayerShape, dict[Sizes, float]] = field(default_factory=dict[LayerShape, dict[Sizes, float]])
    refused: dict[tuple[int, Sizes], str] = field(default_factory=dict[tuple[int, Sizes], str])

    def time(self, device: Device, shape: LayerShape, size: tuple[int, int], candidates: Iterable[Sizes], rounds: int) -> None:
        """Record the fastest of interleaved runs of every candidate whose results are the plain kernel's, within the bound.

        Args:
            device: to run on.
            shape: the layer's shape.
            size: (height, width) of the frame.
            candidates: tile sizes, timed in turns.
            rounds: timings of each.
        """
        packed = _pack(shape)
        small = _Layer(device, shape, CHECK_SIZE, packed)
        frame = _Layer(device, shape, (ceil8(size[0]) // shape.divisor, ceil8(size[1]) // shape.divisor), packed)
        want = small.run(PLAIN)
        launches: dict[Sizes, tuple[Launch, int]] = {}
        for sizes in dict.fromkeys(candidates):
            if why := small.fault(sizes, want):
                self.refused[shape.outputs, sizes] = why
                continue
            launch = frame.launch(sizes)
            _seconds(device, launch, 1)
            launches[sizes] = launch, max(1, round(MIN_DURATION / _seconds(device, launch, 1)))
        best = self.times[shape] = dict.fromkeys(launches, np.inf)
        for _ in range(rounds):
            for sizes, (launch, repeat) in launches.items():
                best[sizes] = min(best[sizes], _seconds(device, launch, repeat))

    def total(self, sizes: Sizes | None, shapes: Iterable[LayerShape]) -> float:
        """Seconds in all layers with these shapes; infinite if the sizes were refused or not timed."""
        if sizes is None:
            return np.inf
        return sum(shape.count * self.times[shape].get(sizes, np.inf) for shape in shapes)

    def totals(self, kind: type[Sizes], shapes: Sequence[LayerShape]) -> dict[Sizes, float]:
        """The totals of all timed sizes of this kind."""
        candidates = dict.fromkeys(c for shape in shapes for c in self.times[shape] if isinstance(c, kind))
        return {sizes: self.total(sizes, shapes) for sizes in candidates}


def winograd_candidates(device: Properties, outputs: int) -> list[Winograd]:
    """Tiles and rows by block: on a CPU accumulators fill 16 or 32 registers of 8 or 16 lanes, elsewhere scratch has little room."""
    wide = outputs // 8
    if not device.is_cpu:
        return [Winograd(tiles, tiles, block) for block in (1, wide) for tiles in (1, 2)]
    by_block = {2: ((6, 6), (12, 6), (8, 4), (8, 8)), 3: ((8, 4), (4, 4), (12, 4), (6, 6), (8, 8)), 4: ((6, 3), (8, 4), (6, 6))}
    candidates = [Winograd(*pair, block) for block, pairs in by_block.items() if wide % block == 0 for pair in pairs]
    double = -(-wide // 2)
    by_block = {2: ((8, 8), (6, 6), (12, 12)), 4: ((6, 6), (4, 4))} if not device.name.startswith(INTEL) else {}
    candidates += [Winograd(*pair, block, 16) for block, pairs in by_block.items() if double % block == 0 for pair in pairs]
    return candidates


def local_candidates(device: Properties) -> list[Local]:
    """Rows of pixels; a processor's work-items share nothing."""
    return [] if device.is_cpu else [Local(1), Local(2)]


def direct_candidates(device: Properties, outputs: int) -> list[Direct]:
    """Pixels by block, as above; work-groups matter only where they share hardware."""
    wide = outputs // 8
    if not device.is_cpu:
        groups = [group for group in (16, 32, 64, 128) if group <= device.max_work_group]
        blocks = [block for block in (1, 2, 3, 4) if wide % block == 0]
        return [Direct(pixels, block, group) for pixels in (1, 2, 4) for block in blocks for group in groups]
    by_block = {2: (2, 4), 3: (2, 4), 4: (2, 4)}
    return [Direct(pixels, block, 1) for block, row in by_block.items() if wide % block == 0 for pixels in row]


class _Layer:
    """Buffers of one layer, the inputs random, and its launches with any tile sizes."""

    def __init__(self, device: Device, shape: LayerShape, size: tuple[int, int], packed: PackedLayer):
        self._device, self._shape, self._packed = device, shape, packed
        random = np.random.default_rng(1)
        inputs = size[0] * shape.stride, size[1] * shape.stride
        self._inputs = [pad(device, *inputs, n, np.dtype(np.float32)) for n in (shape.a, shape.b) if n]
        for buffer in self._inputs:
            write(device, buffer, random.random((*inputs, buffer.channels), dtype=np.float32))
        self._out = pad(device, *size, shape.outputs, np.dtype(np.float32))
        self._nowhere = np.full((*size, shape.outputs), np.nan, np.float32)

    def launch(self, sizes: Sizes) -> Launch:
        """The layer with these tile sizes."""
        outputs = self._shape.outputs
        row = Tuning(
            {outputs: sizes} if isinstance(sizes, Winograd) else None,
            {outputs: sizes} if isinstance(sizes, Direct) else {},
            sizes if isinstance(sizes, Local) else None,
        )
        a, b = (*self._inputs, None)[:2]
        assert a is not None
        with trial(row):
            side = 0 if isinstance(sizes, Direct) else 4
            return conv(self._device, ConvSpec("tune", "layer", self._packed, self._shape.stride, side=side), a, b, self._out)

    def run(self, sizes: Sizes) -> Array:
        """Its output; NaN where nothing was written."""
        write(self._device, self._out, self._nowhere)
        self.launch(sizes).enqueue(self._device.queue)
        return read(self._device, self._out)

    def fault(self, sizes: Sizes, want: Array) -> str:
        """The reason against these sizes, in a few words; "" if they may be used."""
        try:
            error = ratio("stage.cl", self.run(sizes), want)
        except (DeviceError, cl.Error) as fault:
            return " ".join(str(fault).split())
        return "" if error <= 1 else f"departs from the plain kernel by {error:.3g} of the allowed error"


def _seconds(device: Device, launch: Launch, repeat: int) -> float:
    start = time.perf_counter()
    for _ in range(repeat):
        launch.enqueue(device.queue)
    device.queue.finish()
    return (time.perf_counter() - start) / repeat


def _pack(shape: LayerShape) -> PackedLayer:
    """Weights that keep activations of order 1."""
    random, inputs = np.random.default_rng(0), shape.a + shape.b
    branches = {".conv_feature": shape.outputs, ".conv_mask.0": 1} if shape.gated else {"": shape.outputs}
    tensors: dict[str, Array] = {}
    for branch, outputs in branches.items():
        weight = random.standard_normal((outputs, inputs, 3, 3)) / np.sqrt(9 * inputs)
        tensors[f"layer{branch}.weight"] = weight.astype(np.float32)
        tensors[f"layer{branch}.bias"] = random.standard_normal(outputs).astype(np.float32)
    return pack(tensors, "layer", tuple((n, n) for n in (shape.a, shape.b) if n))
