# SPDX-License-Identifier: MIT
"""Convolutions on devices whose work-items share local memory: conv_local.cl, and conv_mma.cl on matrix units."""

from __future__ import annotations

from stss_cl.device import matrix_units
from stss_cl.device.buffers import Padded
from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil_div
from stss_cl.network.layer import Shape
from stss_cl.network.pack_weights import Packed, fragments
from stss_cl.network.tiles import Tiling

WIDE, TALL = 32, 4
"""Pixels of a work-group's tile: along a row, and rows for each row of a work-item."""
EIGHTS, MOST_OUTPUTS, EMULATED = (4, 3, 2, 7), 32, 3072
"""For conv_mma.cl: eights of input channels in local memory at once (the first number that divides all and fits); outputs whose sums fit
the registers; bytes of local memory for emulated products."""


def local(device: Device, packed: Packed, out: Padded, stride: int, most_rows: int, images: int) -> Shape:
    """The shape of conv_local.cl for this layer; a work-item has at most ``most_rows`` rows of pixels."""
    slices, rows = packed.direct.shape[-1] // 8, _rows(device, out, most_rows, images)
    tiling = _tiling(out, rows, stride, images)
    return Shape(
        file="conv_local.cl",
        options={"STRIDE": stride, "ROWS": rows, "IMAGES": images > 1},
        weight=packed.direct,
        gate=packed.gate_direct,
        tiling=tiling,
        size=(8 * tiling.most, 4, slices),
        group=(8, 4, slices),
    )


def on_matrix_units(device: Device, packed: Packed, out: Padded, stride: int, most_rows: int, images: int) -> Shape:
    """The shape of conv_mma.cl for this layer; a work-item has at most ``most_rows`` rows of pixels."""
    inner, outputs = packed.direct.shape[2] // 8, packed.direct.shape[3]
    # Tiles of twice the side and eights of all channels would not fit into local memory together, nor seven at once into the registers.
    rows = 1 if stride == 2 or inner % 7 == 0 else _rows(device, out, most_rows, images)
    plane = 16 * (34 * stride * (stride * (TALL * rows - 1) + 3) + 2)  # bytes of an eight in local memory
    eights = next((n for n in EIGHTS if inner % n == 0 and n * plane + EMULATED <= device.local_memory), 1)
    block = next(n for n in (outputs, MOST_OUTPUTS, MOST_OUTPUTS - 8) if n <= MOST_OUTPUTS and outputs % n == 0)
    tiling = _tiling(out, rows, stride, images)
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
        size=(matrix_units.LANES * tiling.most, matrix_units.WAVES * (outputs // block)),
        group=(matrix_units.LANES, matrix_units.WAVES),
    )


def _rows(device: Device, out: Padded, most: int, images: int) -> int:
    """Rows of pixels of a work-item: layers with few tiles get smaller ones, which use more of the device."""
    tiles = images * ceil_div(out.width, WIDE) * ceil_div(out.height, TALL * most)
    return most if tiles >= 2 * device.compute_units else 1


def _tiling(out: Padded, rows: int, stride: int, images: int) -> Tiling:
    tall = TALL * rows
    across = ceil_div(out.width, WIDE)
    return Tiling(ceil_div(out.height, tall), across, (stride * tall, stride * WIDE), 1, 1 - stride, images)
