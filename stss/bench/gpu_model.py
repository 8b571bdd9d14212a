# SPDX-License-Identifier: MIT
"""Estimate the network's time on a GPU that is not here, from counts and published rates; nothing is measured.

The host code's launches for a GPU give the counts, and the compiled kernels the shares of instructions
(``python -m tests.offline``). The time of a launch is the longest of the times that its demands on each unit take, or that one
work-group takes by itself.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from stss_cl.device import matrix_units
from stss_cl.device.buffers import Outgoing
from stss_cl.device.discovery import Device, Properties, open_device
from stss_cl.device.launch import enqueue
from stss_cl.device.matrix_units import ARC, NVIDIA, RDNA3, Form
from stss_cl.device.tuning import BUILT_IN, built_in_rows, trial
from stss_cl.network.layer import LayerLaunch
from stss_cl.network.layers import Layers
from stss_cl.network.network import Precision
from stss_ref.weights import Weights, colors_read


@dataclass(frozen=True)
class Gpu:
    """Published peak rates of a GPU.

    Attributes:
        name: shown in tables.
        row: name of its row in ``tuning.toml``.
        form: of its matrix units.
        units: number of multiprocessors or compute units.
        ghz: boost clock; GHz.
        multiply_adds: float32 multiply-adds of a unit in a clock.
        matrix: multiply-adds of a unit's matrix units in a clock, half with float32 sums.
        l2, memory: rates of the L2 cache and of the memory; GB/s.
        cache: size of L2 and of the cache behind it; MB.
    """

    name: str
    row: str
    form: Form
    units: int
    ghz: float
    multiply_adds: int
    matrix: int
    l2: float
    memory: float
    cache: float


GPUS = {
    "h100": Gpu("H100 SXM", "nvidia", NVIDIA, 132, 1.83, 128, 1240, 5500, 3350, 50),  # mma.sync reaches 0.6 of what wgmma does
    "a100": Gpu("A100 SXM", "nvidia", NVIDIA, 108, 1.41, 64, 1024, 4000, 1555, 40),
    "rtx4090": Gpu("RTX 4090", "nvidia", NVIDIA, 128, 2.52, 128, 256, 5000, 1008, 72),
    "rtx3090": Gpu("RTX 3090", "nvidia", NVIDIA, 82, 1.695, 128, 256, 2300, 936, 6),
    "rx7900xtx": Gpu("RX 7900 XTX", "amd", RDNA3, 96, 2.5, 128, 256, 3500, 960, 96),
    "a770": Gpu("Arc A770", "intel", ARC, 32, 2.1, 128, 1024, 2000, 560, 16),
}

GAP = 1.5e-6
"""Seconds from the end of a launch to the start of the next one, if that is enqueued already."""
LOCAL_BYTES = 128
"""Bytes of local memory that a unit reads in a clock."""
ISSUED = 0.92
"""Share of its issue slots that a unit with enough work fills."""
ALONE = 1.3
"""Clocks per instruction of a group that has a unit to itself: no other group's work hides its loads."""
SHARE = {"conv_local": 0.90, "conv": 0.70, "NVIDIA": 0.31, "RDNA3": 0.15, "ARC": 0.15}
"""Share of multiply-adds among all instructions of a kernel, inside and outside its hottest loop; of conv_mma.cl by the form of matrix
units. Compiled for sm_90, gfx1100 and dg2."""
ISSUES = {"NVIDIA": 4, "RDNA3": 2, "ARC": 16}
"""Instructions that a unit issues in a clock."""
SHORTEST, ROUNDS, MOST_REPEATS = 5e-3, 5, 200
"""Least seconds of a timing, which repeats its launches until then; timings of each; most repetitions."""
L1_LINES = 4
"""Cache lines that a unit looks up in a clock: this limits the plain convolution, since each of its work-items reads other lines."""


@dataclass(frozen=True)
class Estimate:
    """The estimate for one launch.

    Attributes:
        stage, name: of the layer.
        kernel: of ``kernels/``, without suffix.
        seconds: limit (memory, arithmetic, ...) -> seconds that the launch takes if only that limits it.
        roof: seconds of its arithmetic at the peak rate; 0 for kernels other than convolutions.
    """

    stage: str
    name: str
    kernel: str
    seconds: dict[str, float]
    roof: float

    @property
    def limit(self) -> str:
        """The limit that takes longest, a key of ``seconds``."""
        return max(self.seconds, key=lambda key: self.seconds[key])

    @property
    def total(self) -> float:
        """Seconds of the launch, with the gap to the next one."""
        return max(self.seconds.values()) + GAP


class Modelled(Device):
    """The device at hand, treated as a GPU with as many units as ``gpu``, so that it makes the launches that ``gpu`` would get."""

    def __init__(self, gpu: Gpu):
        opened = open_device(device_class="gpu")
        super().__init__(opened.handle, opened.context, opened.queue, opened.device_class)
        self._units = gpu.units

    @property
    def compute_units(self) -> int:
        """Number of units of the modelled GPU."""
        return self._units


def most_like(device: Properties) -> str:
    """The name in ``GPUS`` that the device's own has in it, or else the first of its maker, or else the first of all."""
    name = re.sub(r"[^a-z0-9]", "", device.name.lower())
    of_maker = (key for key, gpu in GPUS.items() if gpu.row == device.maker)
    return next((key for key in GPUS if key in name), next(of_maker, next(iter(GPUS))))


def predict(weights: Weights, height: int, width: int, gpu: Gpu, precision: Precision) -> list[Estimate]:
    """Estimate every launch of the network for whole frames.

    Args:
        weights: the 92 tensors.
        height, width: H, W of the inputs; pixels.
        gpu: the GPU, with its row of tile sizes.
        precision: of the network.

    Returns:
        The estimates, in the order of the launches.
    """
    with trial(built_in_rows(BUILT_IN)[0][gpu.row]), matrix_units.trial((gpu.form,)):
        return [estimate(layer, gpu) for layer in Layers(Modelled(gpu), weights, height, width, precision).launches]


def predict_frame(weights: Weights, height: int, width: int, gpu: Gpu, precision: Precision) -> list[Estimate]:
    """Estimate the launches of an extrapolated frame around the network; its planes are on the device, and each is read once.

    Arguments are those of `predict`. All of them are limited by memory or L2.
    """
    frames, stored = colors_read(weights), 2 if precision == "half" else 4
    surface = 9 + 1 + 1 + 3  # G-buffer, NoV, stencil, position
    floats = {
        "arrive": 2 + surface,
        "chain_steps": 2 * ((2 * frames - 1) + frames),
        # Of each colour frame motion, colour, stencil, position; the decoder's base; normals are read where something moves.
        "prepare": surface + frames * (2 + 3 + 1 + 3) + 4,
        "splat_nearest": 2 + 1,
        "splat_first": 2 + 1,
        "fill_holes": 0,
        "downsample_8": 9 * 2 / 8,  # two rows of eight
    }
    packed = 24 + (frames * 4 if frames > 1 else 0)
    rows = []
    for name, count in floats.items():
        # A byte of the mask of holes, which all read or write that know of holes.
        size = (
            height * width * (4 * count + (stored * packed if name == "prepare" else 0) + (name not in ("arrive", "chain_steps")))
        )
        limit, rate = ("L2", gpu.l2) if size < gpu.cache * 1e6 else ("memory", gpu.memory)
        rows.append(Estimate("frame", name, name, {limit: size / rate / 1e9}, 0.0))
    return rows


def measure(
    weights: Weights, height: int, width: int, gpu: Gpu, precision: Precision, name: str | None
) -> tuple[list[Estimate], list[float], float]:
    """Estimate and time every launch of the network on a device that is here, with the device's own row of tile sizes.

    Args:
        weights, height, width, gpu, precision: see `predict`.
        name: part of the device's name; None: the default.

    Returns:
        The estimate of each launch; the measured seconds of each; the measured seconds of all in a row.
    """
    device = open_device(name)
    layers = Layers(device, weights, height, width, precision)
    image = Outgoing(device, (2 * height, 2 * width, 3), on_device=True)
    ready = layers.ready(image.data)
    return [estimate(layer, gpu) for layer in ready], [_seconds(device, [layer]) for layer in ready], _seconds(device, ready)


def _seconds(device: Device, launches: Sequence[LayerLaunch]) -> float:
    """Seconds of these launches: the least of a few rounds, each so long that its start and end hardly count."""
    best, repeat = math.inf, 1
    for _ in range(ROUNDS):
        device.queue.finish()
        start = time.perf_counter()
        for _ in range(repeat):
            enqueue(device, launches)
        device.queue.finish()
        took = time.perf_counter() - start
        best, repeat = min(best, took / repeat), max(1, min(MOST_REPEATS, math.ceil(repeat * SHORTEST / took)))
    return best


def estimate(layer: LayerLaunch, gpu: Gpu) -> Estimate:
    """Estimate one launch on ``gpu``."""
    source = layer.source
    read = _bytes(layer, ("a", "b", "feature", "color", "key", "unit", "value", "eighth", "in"))
    written = _bytes(layer, ("out", "image", "reshaded"))
    rate = gpu.l2 if read + written < gpu.cache * 1e6 else gpu.memory
    seconds = {"memory" if rate == gpu.memory else "L2": (read + written) / rate / 1e9}
    kernels = {"conv_local": _local, "conv_mma": _matrix, "conv": _plain}
    if source.kernel not in kernels:
        return Estimate(layer.stage, layer.name, source.kernel, seconds, 0.0)
    options: dict[str, Any] = dict(source.options)
    shape = {key: int(options.get(key, 0)) for key in ("A", "B", "OUT", "STRIDE", "ROWS", "GATED", "KERNEL", "BLOCK")}
    height, width = int(layer.arguments["height"]) * layer.tiling.images, int(layer.arguments["width"])
    products = 9 * (shape["A"] + shape["B"])
    useful = products * (shape["OUT"] + shape["GATED"]) * height * width
    clock = gpu.units * gpu.ghz * 1e9
    peak = gpu.matrix if source.kernel == "conv_mma" else gpu.multiply_adds
    cycles = kernels[source.kernel](shape, height, width, gpu)
    seconds |= {key: number / gpu.ghz / 1e9 for key, number in cycles.items()}
    return Estimate(layer.stage, layer.name, source.kernel, seconds, useful / peak / clock)


def _local(shape: dict[str, int], height: int, width: int, gpu: Gpu) -> dict[str, float]:
    """Cycles of conv_local.cl: a unit of 128 lanes issues 4 instructions of 32 work-items a clock, one of 64 lanes 2."""
    slices, rows, inner = shape["OUT"] // 8, shape["ROWS"], shape["A"] + shape["B"]
    groups = math.ceil(width / 32) * math.ceil(height / (4 * rows))
    multiply_adds = 9 * inner * 4 * rows * (8 + shape["GATED"] / slices)  # of a work-item
    instructions = multiply_adds / SHARE["conv_local"]
    busiest = math.ceil(groups / gpu.units)
    # Reads of 32 work-items for a channel: weights, 16 bytes at a time to all of them, and rows of the tile, 128 bytes at a time.
    wavefronts = inner * (18 + (shape["STRIDE"] * (rows - 1) + 3) * (6 if shape["STRIDE"] == 1 else 9))
    return {
        "arithmetic": busiest * slices * instructions / (gpu.multiply_adds / 32) / ISSUED,
        "local memory": busiest * slices * wavefronts,
        "one group": instructions * ALONE,
    }


def _matrix(shape: dict[str, int], height: int, width: int, gpu: Gpu) -> dict[str, float]:
    """Cycles of conv_mma.cl: inputs from local memory, weights from the cache that shares its lines."""
    form, rows, inner, block = gpu.form, shape["ROWS"], shape["A"] + shape["B"], shape["BLOCK"]
    groups = math.ceil(width / 32) * math.ceil(height / (4 * rows)) * (shape["OUT"] // block)
    matrices, steps = math.ceil((block // form.parts + shape["GATED"]) / form.held), math.ceil(9 * inner / 16)
    products = steps * matrices * 2 * rows  # of a wave
    size = form.unit * 16 * form.parts * form.held
    busiest = math.ceil(groups / gpu.units) * form.waves
    share, issues = SHARE[form.name], ISSUES[form.name]
    return {
        "arithmetic": busiest * products * size / gpu.matrix / ISSUED,
        "issue": busiest * products / share / issues,
        "local memory": busiest * steps * (2 * rows * form.unit + matrices * form.parts * form.held) * 32 / LOCAL_BYTES,
        "one group": products * max(ALONE * 2 / share, size * issues / gpu.matrix),
    }


def _plain(shape: dict[str, int], height: int, width: int, gpu: Gpu) -> dict[str, float]:
    """Cycles of conv.cl: each input of each pixel looks up a line of its own; each weight is one look-up for all pixels."""
    inner, blocks = shape["A"] + shape["B"], shape["OUT"] // 8 // max(shape["BLOCK"], 1)
    products = shape["KERNEL"] ** 2 * inner
    items = height * width * blocks / 32 / gpu.units
    multiply_adds = items * products * (8 * shape["BLOCK"] + shape["GATED"] / blocks)
    return {
        "arithmetic": multiply_adds / SHARE["conv"] / (gpu.multiply_adds / 32) / ISSUED,
        "L1": items * products * (32 / L1_LINES + shape["BLOCK"]),
    }


def _bytes(layer: LayerLaunch, names: Iterable[str]) -> int:
    """Bytes of the buffers with these argument names; each buffer counts once."""
    buffers: dict[int, Any] = {id(layer.arguments[name]): layer.arguments[name] for name in names if name in layer.arguments}
    return sum(int(buffer.size) for buffer in buffers.values())
