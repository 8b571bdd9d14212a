# SPDX-License-Identifier: MIT
"""Sizes of launches: whole work-groups, whole blocks of channels."""

from __future__ import annotations

from stss_cl.device.discovery import Device


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


def span(device: Device, pixels: int) -> int:
    """Pixels of a row that a work-item looks after where only what changed is computed; ``pixels``: what it computes at once.

    On a processor they are more: most work-items have nothing to do, and each of them costs something.
    """
    return ceil_div(32, pixels) * pixels if device.is_cpu else pixels
