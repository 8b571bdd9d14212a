# SPDX-License-Identifier: MIT
"""Lists of the tiles that a layer computes (kernels/tile_list.clh), and the launch that finds the tiles reached by marks of its inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import constant
from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil_div, grid
from stss_cl.device.launch import Kernel, Launch
from stss_cl.device.program import program_for

SIDE = 4
"""Side of most tiles; pixels. Kernels and change maps count in it: it is no choice of tuning."""
SPAN_PIXELS = 256
"""Pixels. On a CPU tiles that step over them share a work-item: most have nothing to do, and each work-item costs something."""


@dataclass(frozen=True)
class TileList:
    """Two buffers: ``tiles`` has a uint32 for each tile, row << 16 | column; ``count`` is their number, int32 (1)."""

    tiles: cl.Buffer
    count: cl.Buffer


@dataclass(frozen=True)
class Tiling:
    """The tiles of a layer's output, and the pixels of its inputs that each tile reads.

    Attributes:
        rows, columns: numbers of an image's tiles.
        step: (y, x) pixels of the inputs from one tile to the next.
        before, beyond: tile t reads, along both axes, the pixels step * t - before .. step * (t + 1) + beyond.
        images: number of images of the output, one behind the other; the rows of a list count through all of them.
    """

    rows: int
    columns: int
    step: tuple[int, int]
    before: int
    beyond: int
    images: int = 1

    @property
    def lines(self) -> int:
        """Number of rows of tiles of all images."""
        return self.images * self.rows

    @property
    def most(self) -> int:
        """Number of all tiles."""
        return self.lines * self.columns


def of_convolution(height: int, width: int, stride: int, size: int, side: int = SIDE) -> Tiling:
    """The tiling of a convolution of ``size`` x ``size`` with an output of (height, width), in tiles of ``side`` pixels."""
    step = stride * side
    return Tiling(ceil_div(height, side), ceil_div(width, side), (step, step), size // 2, size // 2 - stride)


class Maps(NamedTuple):
    """Change maps of a layer's inputs, up to three of one size; the first buffer's map begins at element ``first``."""

    buffers: tuple[cl.Buffer, ...]
    rows: int
    columns: int
    first: int = 0


_whole: WeakKeyDictionary[cl.Context, dict[tuple[int, int, int], TileList]] = WeakKeyDictionary()


def whole(device: Device, rows: int, columns: int, first: int = 0) -> TileList:
    """The list of all tiles from row ``first`` on; made once for each size."""
    lists = _whole.setdefault(device.context, {})
    if (rows, columns, first) not in lists:
        y, x = np.mgrid[first:rows, :columns].astype(np.uint32)
        lists[rows, columns, first] = TileList(
            constant(device, (y << 16 | x).ravel()), constant(device, np.array([y.size], np.int32))
        )
    return lists[rows, columns, first]


def find_tiles(device: Device, tiling: Tiling, maps: Maps, to: TileList) -> Launch:
    """The launch that lists the tiles that marks reach; ``to.count`` must be 0 before."""
    span = min(SPAN_PIXELS // tiling.step[1], 64) if device.is_cpu else 1
    a, b, c = (*maps.buffers, *2 * maps.buffers[-1:])[:3]
    arguments = {
        "a": a, "b": b, "c": c, "a_first": maps.first, "map_rows": maps.rows, "map_columns": maps.columns,
        "step_y": tiling.step[0], "step_x": tiling.step[1], "before": tiling.before, "beyond": tiling.beyond,
        "rows": tiling.rows, "columns": tiling.columns, "images": tiling.images, "span": span,
        "tiles": to.tiles, "count": to.count,
    }  # fmt: skip
    size, group = grid(device, ceil_div(tiling.columns, span), tiling.lines)
    if device.is_cpu:
        size, group = (ceil_div(tiling.columns, span), tiling.lines), (1, 1)
    program = program_for(device, "tile_list.cl", {"SPAN_PIXELS": SPAN_PIXELS} if device.is_cpu else {})
    return Launch("tile_list", Kernel(program, "tile_list", arguments), arguments, size, group)
