# SPDX-License-Identifier: MIT
"""Convolution, gated convolution and their activations: channels last, zero padding, a matrix product for each tap."""

from __future__ import annotations

import numpy as np

from stss_ref.arrays import Array, ArrayError, Image
from stss_ref.weights import Tensors

IN_CACHE = 2**15
"""Numbers of the rows that are summed at a time: all taps find them in the cache, which halves the time and changes no bit."""


def conv(x: Image, weight: Array, bias: Array, stride: int = 1) -> Image:
    """2-D convolution (cross-correlation) with an odd kernel, zero padding that keeps the size at stride 1.

    ``y[i, j, o] = bias[o] + sum_{u, v, c} weight[o, c, u, v] x[stride i + u - r, stride j + v - r, c]``, ``r = (k - 1) / 2``

    Source: spec 7.

    Args:
        x: (H, W, C).
        weight: (O, C, k, k), as in the authors' checkpoint.
        bias: (O,).
        stride: 1 or 2.

    Returns:
        (ceil(H / stride), ceil(W / stride), O), dtype of ``x``.

    Raises:
        ArrayError: channels do not fit the weight.
    """
    height, width, channels = x.shape
    outputs, inputs, size, _ = weight.shape
    if inputs != channels:
        raise ArrayError(f"conv: expected {inputs} channels (weight {weight.shape}), got {channels}")

    r = size // 2
    padded = surround_with_zeros(x, r)
    rows, columns = -(-height // stride), -(-width // stride)
    y = np.empty((rows, columns, outputs), x.dtype)
    y[...] = bias
    taps = np.ascontiguousarray(weight.transpose(2, 3, 1, 0))
    at_once = max(1, IN_CACHE // (columns * outputs))
    for first in range(0, rows, at_once):
        block = y[first : first + at_once]
        below = padded[stride * first :]
        for u in range(size):
            for v in range(size):
                # A view: one matrix product per row of pixels, straight from the padded image. No im2col.
                tap = below[u : u + stride * len(block) : stride, v : v + width : stride]
                block += tap @ taps[u, v]
    return y


def surround_with_zeros(x: Image, r: int) -> Image:
    """``x`` (H, W, C) with ``r`` rows and columns of zeros on each side."""
    height, width, channels = x.shape
    padded = np.zeros((height + 2 * r, width + 2 * r, channels), x.dtype)
    padded[r : r + height, r : r + width] = x
    return padded


def sigmoid(x: Array) -> Array:
    """``1 / (1 + exp(-x))`` without overflow, accurate in both tails."""
    small = np.exp(-np.abs(x))
    return np.where(x >= 0, 1, small) / (1 + small)


def relu(x: Array) -> Array:
    """``max(x, 0)``."""
    return np.maximum(x, 0)


def conv_named(x: Image, weights: Tensors, name: str, stride: int = 1) -> Image:
    """``conv`` with the tensors ``name.weight`` and ``name.bias``."""
    return conv(x, weights[f"{name}.weight"], weights[f"{name}.bias"], stride)


def gated(x: Image, weights: Tensors, name: str, stride: int = 1) -> Image:
    """Gated convolution ``G``: ``conv(x) sigmoid(gate(x))``, where the gate is a convolution to one channel.

    Source: spec 7.

    Args:
        x: (H, W, C).
        weights: the network's tensors.
        name: the module's path, e.g. ``down1.conv2``.
        stride: 1 or 2.

    Returns:
        (ceil(H / stride), ceil(W / stride), O); no ReLU.
    """
    feature = conv_named(x, weights, f"{name}.conv_feature", stride)
    return feature * sigmoid(conv_named(x, weights, f"{name}.conv_mask.0", stride))


def conv_chain(x: Image, weights: Tensors, name: str, layers: tuple[int, ...], *, last_relu: bool = True) -> Image:
    """Convolutions ``name.0``, ``name.2``, ... one after the other, with ReLU between them.

    Args:
        x: (H, W, C).
        weights: the network's tensors.
        name: the module's path, e.g. ``convHis1``.
        layers: the stride of each layer.
        last_relu: whether ReLU follows the last one.

    Returns:
        (H', W', O); each stride divides H and W, rounded up.
    """
    for i, stride in enumerate(layers):
        x = conv_named(x, weights, f"{name}.{2 * i}", stride)
        if last_relu or i < len(layers) - 1:
            x = relu(x)
    return x
