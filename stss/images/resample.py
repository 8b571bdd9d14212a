# SPDX-License-Identifier: MIT
"""Read images between their pixels by other kernels than the bilinear one."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stss_ref.arrays import Array, Image

Scalar = TypeVar("Scalar", bound=np.generic)

REACH = 3
"""Lobes of Lanczos's kernel to each side; pixels."""


def lanczos_centres(x: Image, offset: tuple[float, float] = (0, 0)) -> Image:
    """Lanczos x2 with pixel centres aligned: output ``o`` reads ``(o + 1/2) / 2 - 1/2 + offset``.

    ``sum_i w(i - at) x_i / sum_i w(i - at)``, ``w(d) = sinc(d) sinc(d / 3)`` for ``|d| < 3``, over the pixels within the frame.

    Source: Duchon, Lanczos Filtering in One and Two Dimensions, 1979.

    Args:
        x: (H, W, C).
        offset: of the image in x and y, pixels of ``x``.

    Returns:
        (2H, 2W, C) as ``x``; overshoots at edges.
    """
    for axis in (0, 1):
        weights = _lanczos_weights(x.shape[axis], offset[1 - axis]).astype(x.dtype)
        x = np.moveaxis(np.tensordot(weights, x, (1, axis)), 0, axis)
    return np.ascontiguousarray(x)


def _lanczos_weights(n: int, offset: float) -> Array:
    """(2n, n) share of each pixel in each output; rows add up to 1."""
    d = np.arange(n) - ((np.arange(2 * n) + 0.5) / 2 - 0.5 + offset)[:, None]
    w = np.where(np.abs(d) < REACH, np.sinc(d) * np.sinc(d / REACH), 0)
    return w / w.sum(axis=1, keepdims=True)


def enlarge(x: NDArray[Scalar]) -> NDArray[Scalar]:
    """Repeat each pixel of an (H, W, ...) array two times each way: (2H, 2W, ...)."""
    return x.repeat(2, axis=0).repeat(2, axis=1)


def catmull_rom(image: Image, x: Array, y: Array) -> Image:
    """Read an image by Catmull-Rom splines; bilinear reading would blur it further with every frame.

    Source: Keys, Cubic Convolution Interpolation for Digital Image Processing, 1981, with a = -1/2.

    Args:
        image: (H, W, C).
        x, y: (H', W') where to read; finite, clamped into the image.

    Returns:
        (H', W', C); exact at whole pixels.
    """
    height, width, _ = image.shape
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    x0, y0 = np.floor(x), np.floor(y)
    columns = [np.clip(x0.astype(np.intp) + i, 0, width - 1) for i in range(-1, 3)]
    rows = [np.clip(y0.astype(np.intp) + i, 0, height - 1) for i in range(-1, 3)]
    across, down = _cubic(x - x0), _cubic(y - y0)
    result = np.zeros((*x.shape, image.shape[2]), image.dtype)
    for row, v in zip(rows, down, strict=True):
        result += v[..., None] * sum(u[..., None] * image[row, column] for column, u in zip(columns, across, strict=True))
    return result


def _cubic(t: Array) -> tuple[Array, Array, Array, Array]:
    """Weights of the pixels -1, 0, 1, 2 at distance ``t`` in [0, 1) from pixel 0."""
    return (
        t * (-0.5 + t * (1 - 0.5 * t)),
        1 + t * t * (-2.5 + 1.5 * t),
        t * (0.5 + t * (2 - 1.5 * t)),
        t * t * (-0.5 + 0.5 * t),
    )
