# SPDX-License-Identifier: MIT
"""Stage decoder: features back to twice the size, as a residual on the upsampled frame."""

from __future__ import annotations

import numpy as np

from stss_ref.arrays import Image, require
from stss_ref.conv import conv_chain, conv_named
from stss_ref.resample import pixel_shuffle, upsample_centres, upsample_corners
from stss_ref.weights import Tensors


def decoder(reshaded: Image, feature: Image, x1: Image, x2: Image, x3: Image, color: Image, weights: Tensors) -> Image:
    """The expanding half of the U-Net.

    ``u = concat(reshaded, feature)``; ``u = up1(concat(x3, u2))``, ``up2(concat(x2, u2))``, ``up3(concat(x1, u2))``, where ``u2`` is ``u``
    upsampled with corners aligned; ``image = shuffle(outc(u)) + upsampled(color[0:3])``.

    Source: spec 7; paper, Fig. 5.

    Args:
        reshaded: (H/8, W/8, 64) from the ERM.
        feature: (H/8, W/8, 32) from the history embedding.
        x1: (H, W, 24); x2: (H/2, W/2, 24); x3: (H/4, W/4, 32): from the encoder.
        color: (H, W, 6); its first three channels are upsampled and added.
        weights: the network's tensors.

    Returns:
        image: (2H, 2W, 3), not clipped.

    Raises:
        ArrayError: shapes differ.
    """
    require(
        {
            "reshaded": (reshaded, "h, w, 64"), "feature": (feature, "h, w, 32"), "x1": (x1, "8h, 8w, 24"), "x2": (x2, "4h, 4w, 24"),
            "x3": (x3, "2h, 2w, 32"), "color": (color, "8h, 8w, 6"),
        }
    )  # fmt: skip

    u = np.concatenate([reshaded, feature], axis=-1)
    for name, skip in (("up1", x3), ("up2", x2), ("up3", x1)):
        u = np.concatenate([skip, upsample_corners(u)], axis=-1)
        u = conv_chain(u, weights, f"{name}.conv.double_conv", (1, 1))
    return pixel_shuffle(conv_named(u, weights, "outc")) + upsample_centres(color[..., :3])
