# SPDX-License-Identifier: MIT
"""Stage erm: the Efficient Reshading Module, attention to nearby pixels of similar material."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from stss_ref.arrays import Image, Plane, require
from stss_ref.conv import conv_chain, surround_with_zeros
from stss_ref.resample import downsample_8
from stss_ref.weights import Tensors

WINDOW = 5
"""Side of the attention window, in pixels at 1/8 size (paper, Eq. 5)."""
LEAST_LENGTH, LEAST_SUM = 1e-12, 1e-6
"""Least length of a key, and least sum of weights, that is divided by (spec 8)."""


def erm(x4: Image, gbuffer: Image, mask: Plane, weights: Tensors) -> Image:
    """Reshade each place with the light of its neighbours, weighted by how alike their materials are.

    ``V = latentEncoder(concat(x4, f)) m``, ``K = KEncoder(f) / |KEncoder(f)|``,
    ``phi(p) = sum_d w(d) V(p + d) / max(sum_d w(d), 1e-6)``, ``w(d) = relu(m(p + d) K(p + d) . K(p))``,
    where ``f``, ``m`` are gbuffer and mask at 1/8 size.

    Source: spec 8; paper, Eq. 4, 5.

    Args:
        x4: (H/8, W/8, 32) from the encoder.
        gbuffer: (H, W, 9).
        mask: (H, W) 1 = to be trusted.
        weights: the network's tensors.

    Returns:
        reshaded: (H/8, W/8, 64); 0 where nothing in the window is to be trusted.

    Raises:
        ArrayError: shapes differ.
    """
    require({"x4": (x4, "h, w, 32"), "gbuffer": (gbuffer, "8h, 8w, 9"), "mask": (mask, "8h, 8w")})

    f, m = downsample_8(gbuffer), downsample_8(mask[..., None])
    light = conv_chain(np.concatenate([x4, f], axis=-1), weights, "latentEncoder", (1, 1, 1), last_relu=False)
    material = normalise(conv_chain(f, weights, "KEncoder", (1, 1, 1), last_relu=False))
    return reshade(light, material, m)


def normalise(x: Image) -> Image:
    """``x`` (H, W, C) divided by its length over the channels, at least 1e-12."""
    return x / np.maximum(np.sqrt((x * x).sum(axis=-1, keepdims=True)), x.dtype.type(LEAST_LENGTH))


def reshade(light: Image, material: Image, m: Image) -> Image:
    """The light of like materials; only trusted places count (``m``, (H, W, 1))."""
    return attend(material, material * m, light * m)


def attend(query: Image, key: Image, value: Image) -> Image:
    """``sum_d relu(key(p + d) . query(p)) value(p + d) / max(sum_d relu(key(p + d) . query(p)), 1e-6)`` over the window.

    Args:
        query: (H, W, K).
        key: (H, W, K); outside the frame 0.
        value: (H, W, V); outside the frame 0.

    Returns:
        (H, W, V).
    """
    total = np.zeros_like(value)
    weight_sum = np.zeros_like(value[..., :1])
    for key_there, value_there in zip(window(key), window(value), strict=True):
        weight = likeness(key_there, query)
        total += weight * value_there
        weight_sum += weight
    return divide(total, weight_sum)


def window(x: Image) -> Iterator[Image]:
    """``x`` (H, W, C) at each place ``p + d`` of the window, row by row; outside the frame 0."""
    height, width, _ = x.shape
    padded = surround_with_zeros(x, WINDOW // 2)
    for v in range(WINDOW):
        for u in range(WINDOW):
            yield padded[v : v + height, u : u + width]


def likeness(key: Image, query: Image) -> Image:
    """(H, W, 1) ``relu(key . query)``."""
    return np.maximum((key * query).sum(axis=-1, keepdims=True), 0)


def divide(total: Image, weight_sum: Image) -> Image:
    """``total`` (H, W, V) by the sum of weights (H, W, 1), at least 1e-6."""
    return total / np.maximum(weight_sum, weight_sum.dtype.type(LEAST_SUM))
