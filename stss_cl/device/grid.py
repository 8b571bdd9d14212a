# SPDX-License-Identifier: MIT
"""Sizes of launches: whole work-groups, whole blocks of channels."""

from __future__ import annotations

from math import lcm

from stss_cl.device.discovery import Device

PARTS = 128
"""Of a list of tiles, for each of a processor's cores: few, so that starting them costs nothing, and enough that no core waits long."""
GROUP = 64
"""Work-items of a work-group where they share tiles, on a GPU: what runs together, or a multiple of it."""


def ceil_div(a: int, b: int) -> int:
    """``a / b`` rounded up."""
    return -(-a // b)


def ceil8(channels: int) -> int:
    """Channels with the zeros that fill them up to a multiple of 8."""
    return ceil_div(channels, 8) * 8


def grid(device: Device, width: int, height: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Global size and work-group of a kernel with one work-item a place: whole work-groups, so some lie beyond ``width`` x ``height``.

    The group does not follow the size: PoCL compiles a kernel anew for every group that it has not had.
    """
    columns, rows = (64, 1) if device.is_cpu else (32, 8)
    return (ceil_div(width, columns) * columns, ceil_div(height, rows) * rows), (columns, rows)


def list_size(device: Device, tiles: int, strip: int = 1, workers: int = 1, group: int = 1) -> int:
    """Work-items for a list of at most so many tiles (kernels/tile_list.clh).

    Args:
        device: to run on.
        tiles: in the list.
        strip: tiles that a work-item computes at once.
        workers: work-items that share a tile.
        group: of the launch.
    """
    parts = ceil_div(tiles, strip)
    if device.is_cpu:
        parts = min(parts, PARTS * int(device.handle.max_compute_units))
    whole = lcm(group, workers)
    return ceil_div(parts * workers, whole) * whole
