# SPDX-License-Identifier: MIT
"""Stage encoder: the current frame's features at full, 1/2, 1/4 and 1/8 size."""

from __future__ import annotations

import numpy as np

from stss_ref.arrays import Image, Plane, require
from stss_ref.conv import gated, relu
from stss_ref.rrm import concat_masked
from stss_ref.weights import Tensors


def encoder(color: Image, gbuffer: Image, mask: Plane, weights: Tensors) -> tuple[Image, Image, Image, Image]:
    """The contracting half of the U-Net.

    ``x1 = conv2(conv1(concat(color, color mask, gbuffer)))``, ``x2 = down1(x1)``, ``x3 = down2(x2)``, ``x4 = down3(x3)``.

    Source: spec 7; paper, Fig. 5.

    Args:
        color: (H, W, 6) occlusion_warp and warped of the newest frame; display-referred, [0, 1].
        gbuffer: (H, W, 9) normal 3, depth, roughness, metallic, base colour 3.
        mask: (H, W) 1 = to be trusted.
        weights: the network's tensors.

    Returns:
        x1: (H, W, 24); x2: (H/2, W/2, 24); x3: (H/4, W/4, 32); x4: (H/8, W/8, 32).

    Raises:
        ArrayError: shapes differ.
    """
    require({"color": (color, "H, W, 6"), "gbuffer": (gbuffer, "H, W, 9"), "mask": (mask, "H, W")})

    x = np.concatenate([concat_masked(color, mask), gbuffer], axis=-1)
    x1 = gated_relu(gated_relu(x, weights, "conv1"), weights, "conv2")
    x2 = _down(x1, weights, "down1")
    x3 = _down(x2, weights, "down2")
    x4 = _down(x3, weights, "down3")
    return x1, x2, x3, x4


def _down(x: Image, weights: Tensors, name: str) -> Image:
    """One gated convolution with stride 2 and no ReLU, then two with ReLU."""
    x = gated(x, weights, f"{name}.downsample", stride=2)
    return gated_relu(gated_relu(x, weights, f"{name}.conv1"), weights, f"{name}.conv2")


def gated_relu(x: Image, weights: Tensors, name: str) -> Image:
    """Gated convolution of stride 1, then ReLU."""
    return relu(gated(x, weights, name))
