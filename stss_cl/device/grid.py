# SPDX-License-Identifier: MIT
"""Sizes of launches: whole work-groups, whole blocks of channels."""

from __future__ import annotations

from math import lcm

from stss_cl.device.discovery import Device

PARTS = 128
"""Parts of a list of tiles for each core of a CPU: few, so that starting them costs little, but enough that no core waits long."""
GROUP = 64
"""Work-items of a work-group that share tiles on a GPU: a multiple of the number that runs together."""


def ceil_div(a: int, b: int) -> int:
    """``a / b`` rounded up."""
    return -(-a // b)


def ceil8(channels: int) -> int:
    """Channels with the zeros that fill them up to a multiple of 8."""
    return ceil_div(channels, 8) * 8


def grid(device: Device, width: int, height: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Global size and work-group of a kernel with one work-item for each pixel; whole groups, so some lie beyond ``width`` x ``height``.

    The group does not depend on the size, since PoCL compiles a kernel anew for every new size of group.
    """
    columns, rows = (64, 1) if device.is_cpu else (32, 8)
    return (ceil_div(width, columns) * columns, ceil_div(height, rows) * rows), (columns, rows)


def list_size(device: Device, tiles: int, strip: int = 1, workers: int = 1, group: int = 1) -> int:
    """The number of work-items for a list of tiles (kernels/tile_list.clh).

    Args:
        device: to run on.
        tiles: most tiles in the list.
        strip: tiles that a work-item computes at once.
        workers: work-items that share a tile.
        group: work-group size of the launch.
    """
    parts = ceil_div(tiles, strip)
    if device.is_cpu:
        parts = min(parts, PARTS * int(device.handle.max_compute_units))
    whole = lcm(group, workers)
    return ceil_div(parts * workers, whole) * whole
