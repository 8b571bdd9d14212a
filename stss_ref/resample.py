# SPDX-License-Identifier: MIT
"""Changes of size: x2 on each of the two pixel grids, /8, pixel shuffle, padding to a multiple of 8."""

from __future__ import annotations

import numpy as np

from stss_ref.arrays import Array, Image
from stss_ref.sample import lerp


def upsample_corners(x: Image) -> Image:
    """Bilinear x2 with corner pixels aligned: output ``o`` of ``N`` reads input position ``o (n - 1) / (N - 1)``, ``N = 2n``.

    Source: spec 7, decoder.

    Args:
        x: (H, W, C).

    Returns:
        (2H, 2W, C).
    """
    for axis in (0, 1):
        n = x.shape[axis]
        x = lerp_along(x, np.arange(2 * n) * ((n - 1) / (2 * n - 1)), axis)
    return x


def upsample_centres(x: Image) -> Image:
    """Bilinear x2 with pixel centres aligned: output ``o`` reads ``(o + 1/2) / 2 - 1/2``, clamped to the edges.

    Source: spec 7, the image added to the output; spec 6, the mask of the loss.

    Args:
        x: (H, W, C).

    Returns:
        (2H, 2W, C).
    """
    for axis in (0, 1):
        n = x.shape[axis]
        x = lerp_along(x, np.clip((np.arange(2 * n) + 0.5) / 2 - 0.5, 0, n - 1), axis)
    return x


def lerp_along(x: Array, at: Array, axis: int) -> Array:
    """``x`` read at positions ``at`` (float64, within the axis) along one axis; flat stays flat bit for bit."""
    low = np.floor(at).astype(np.intp)
    high = np.minimum(low + 1, x.shape[axis] - 1)
    t = (at - low).astype(x.dtype).reshape([-1 if i == axis else 1 for i in range(x.ndim)])
    a, b = np.take(x, low, axis), np.take(x, high, axis)
    return lerp(a, b, t)


def downsample_8(x: Image) -> Image:
    """Bilinear / 8 with pixel centres aligned and no prefilter: the mean of pixels ``8i + 3`` and ``8i + 4`` each way.

    Source: spec 8.

    Args:
        x: (H, W, C); H, W multiples of 8.

    Returns:
        (H / 8, W / 8, C).
    """
    half = x.dtype.type(0.5)
    x = (x[3::8] + x[4::8]) * half
    return (x[:, 3::8] + x[:, 4::8]) * half


def pixel_shuffle(x: Image) -> Image:
    """Channels to pixels: output channel ``c``, pixel ``(2y + i, 2x + j)`` is input channel ``4c + 2i + j`` at ``(y, x)``.

    Source: spec 7.

    Args:
        x: (H, W, 4C).

    Returns:
        (2H, 2W, C).
    """
    height, width, channels = x.shape
    blocks = x.reshape(height, width, channels // 4, 2, 2)
    return blocks.transpose(0, 3, 1, 4, 2).reshape(2 * height, 2 * width, channels // 4)


def pad_to_8(x: Array) -> Array:
    """``x`` (..., H, W, C) extended below and right to multiples of 8 by repeating its last row and column (spec 7)."""
    height, width = x.shape[-3:-1]
    widths = [(0, 0)] * (x.ndim - 3) + [(0, -height % 8), (0, -width % 8), (0, 0)]
    return np.pad(x, widths, mode="edge")
