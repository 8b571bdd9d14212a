# SPDX-License-Identifier: MIT
"""Stage network: STSSNet, from warped frames and G-buffer to the image."""

from __future__ import annotations

from stss_ref.arrays import Array, Image, Plane, require
from stss_ref.decoder import decoder
from stss_ref.encoder import encoder
from stss_ref.erm import erm
from stss_ref.history import history_embedding
from stss_ref.resample import pad_to_8
from stss_ref.weights import Weights, astype


def network(color: Image, gbuffer: Image, mask: Plane, history: Array, weights: Weights) -> Image:
    """Compute the image at twice the size.

    Source: spec 7; paper, Fig. 5.

    Args:
        color: (H, W, 6) occlusion_warp and warped of the newest frame (in an SF both are the frame itself); [0, 1].
        gbuffer: (H, W, 9) normal 3, depth, roughness, metallic, base colour 3.
        mask: (H, W) 1 = to be trusted, of the newest frame.
        history: (3, H, W, 4) oldest, middle, newest; each warped colour 3 and its mask.
        weights: the 92 tensors.

    Returns:
        image: (2H, 2W, 3), dtype of ``color``; not clipped. Any H, W: padded to multiples of 8 inside.

    Raises:
        ArrayError: shapes or dtypes differ, or an input is not finite.
    """
    require(
        {"color": (color, "H, W, 6"), "gbuffer": (gbuffer, "H, W, 9"), "mask": (mask, "H, W"), "history": (history, "3, H, W, 4")}
    )
    height, width, _ = color.shape

    weights = astype(weights, color.dtype)
    color, gbuffer, mask, history = (
        pad_to_8(color),
        pad_to_8(gbuffer),
        pad_to_8(mask[..., None])[..., 0],
        pad_to_8(history),
    )
    x1, x2, x3, x4 = encoder(color, gbuffer, mask, weights)
    image = decoder(erm(x4, gbuffer, mask, weights), history_embedding(history, weights), x1, x2, x3, color, weights)
    return image[: 2 * height, : 2 * width]
