# SPDX-License-Identifier: MIT
"""Convolutions on devices whose work-items share local memory: conv_local.cl, and conv_mma.cl on matrix units."""

from __future__ import annotations

from stss_cl.device import matrix_units
from stss_cl.device.buffers import FeatureMap
from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil_div
from stss_cl.network.layer import Shape
from stss_cl.network.pack_weights import PackedLayer, fragments
from stss_cl.network.tiles import Tiling

WIDE, TALL = 32, 4
"""Pixels of a work-group's tile: along a row, and rows for each row of a work-item."""
OUTPUTS = 32, 24, 16, 8
"""Outputs of a work-group, the first of these that divides all: no more fit the registers."""
LEAST_EIGHTS, MANY_EIGHTS, GROUPS, EMULATED = 3, 4, 16, 3072
"""For conv_mma.cl: eights of input channels at once, below which fewer outputs are better; eights above which few tiles are divided by
outputs; work-groups for each compute unit; bytes of local memory for emulated products."""
LOCAL = 48 << 10
"""Most bytes of local memory that conv_mma.cl takes: those of NVIDIA's GPUs. Processors, which have more, emulate the same kernels."""


def local(device: Device, packed: PackedLayer, out: FeatureMap, stride: int, most_rows: int, images: int) -> Shape:
    """The shape of conv_local.cl for this layer; a work-item has at most ``most_rows`` rows of pixels."""
    outputs, rows = packed.direct.shape[-1], _rows(device, out, most_rows, images)
    tiling, slices = _tiling(out, rows, stride, images), next(n for n in OUTPUTS if outputs % n == 0) // 8
    return Shape(
        file="conv_local.cl",
        options={"STRIDE": stride, "ROWS": rows, "SLICES": slices, "IMAGES": images > 1},
        weight=packed.direct,
        gate=packed.gate_direct,
        tiling=tiling,
        size=(8 * tiling.most, 4, outputs // 8),
        group=(8, 4, slices),
    )


def on_matrix_units(device: Device, packed: PackedLayer, out: FeatureMap, stride: int, most_rows: int, images: int) -> Shape:
    """The shape of conv_mma.cl for this layer; a work-item has at most ``most_rows`` rows of pixels."""
    inner, outputs = ceil_div(packed.direct.shape[2], 8), packed.direct.shape[3]
    most_rows = 1 if stride == 2 else _rows(device, out, most_rows, images)
    # Few tiles of many channels, which do not fit at once: fewer outputs of a group use more of the device.
    tiles, least = _tiling(out, most_rows, stride, images).most, 2 * device.compute_units if inner > MANY_EIGHTS else 0
    blocks = [n for n in OUTPUTS if outputs % n == 0]
    blocks = [n for n in blocks if tiles * (outputs // n) >= least] or blocks[-1:]
    fits = [(*max((_eights(device, packed, stride, rows, n), rows) for rows in {most_rows, 1}), n) for n in blocks]
    eights, rows, block = next((fit for fit in fits if fit[0] >= min(inner, LEAST_EIGHTS)), fits[-1])
    tiling = _tiling(out, rows, stride, images)
    # A group has several tiles if it copies its weights only once.
    groups = ceil_div(tiling.most, ceil_div(tiling.most, GROUPS * device.compute_units)) if eights == inner else tiling.most
    return Shape(
        file="conv_mma.cl",
        options={
            "STRIDE": stride,
            "ROWS": rows,
            "OUTPUTS": block,
            "EIGHTS_AT_ONCE": eights,
            "IMAGES": images > 1,
            "EMULATE": matrix_units.are_emulated(device),
        },
        weight=fragments(packed, eights, block),
        gate=None,
        tiling=tiling,
        size=(matrix_units.LANES * groups, matrix_units.WAVES * (outputs // block)),
        group=(matrix_units.LANES, matrix_units.WAVES),
    )


def _eights(device: Device, packed: PackedLayer, stride: int, rows: int, block: int) -> int:
    """Most eights of input channels, a divisor of all, whose tile and weights fit into local memory together; 1 if none does."""
    inner = ceil_div(packed.direct.shape[2], 8)
    plane = 34 * stride * (stride * (TALL * rows - 1) + 3) + 2
    results = block // 8 * (WIDE * TALL * rows + 8)
    matrices = block // 8 + (packed.gate_direct is not None)
    return next(
        (
            n
            for n in range(inner, 1, -1)
            if inner % n == 0
            and 16 * max(n * plane, results) + ceil_div(9 * n, 2) * matrices * matrix_units.BYTES + EMULATED
            <= min(device.local_memory, LOCAL)
        ),
        1,
    )


def _rows(device: Device, out: FeatureMap, most: int, images: int) -> int:
    """Rows of pixels of a work-item: layers with few tiles get smaller ones, which use more of the device."""
    tiles = images * ceil_div(out.width, WIDE) * ceil_div(out.height, TALL * most)
    return most if tiles >= 2 * device.compute_units else 1


def _tiling(out: FeatureMap, rows: int, stride: int, images: int) -> Tiling:
    tall = TALL * rows
    across = ceil_div(out.width, WIDE)
    return Tiling(ceil_div(out.height, tall), across, (stride * tall, stride * WIDE), 1, 1 - stride, images)
