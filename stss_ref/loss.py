# SPDX-License-Identifier: MIT
"""The training loss."""

from __future__ import annotations

import numpy as np

from stss_ref.arrays import Image, Plane, require
from stss_ref.resample import upsample_centres


def loss(output: Image, truth: Image, mask: Plane, perceptual: float = 0.0) -> float:
    """L1 over the frame, once more over the reshading regions, and the perceptual term.

    ``mean |o - y| + sum |o - y| (1 - M) / max(sum (1 - M), 1e-6) + 0.01 perceptual``

    Source: spec 6; paper, Loss Function (its weight 2 in the masked regions, split in two means).

    Args:
        output, truth: (2H, 2W, 3) display-referred.
        mask: (H, W) 1 = to be trusted, the RRM's rectangle included.
        perceptual: a perceptual distance of ``output`` and ``truth``; the trainer chooses it.

    Returns:
        The loss, >= 0. The sums run over pixels and channels alike.

    Raises:
        ArrayError: shapes differ.
    """
    require({"mask": (mask, "H, W"), "output": (output, "2H, 2W, 3"), "truth": (truth, "2H, 2W, 3")})

    m = upsample_mask(mask)[..., None].astype(output.dtype)
    error = np.abs(output - truth)
    masked = np.broadcast_to(1 - m, error.shape)
    return float(error.mean() + (error * masked).sum() / max(masked.sum(), 1e-6) + 0.01 * perceptual)


def upsample_mask(mask: Plane) -> Plane:
    """``M``: the mask (H, W) upsampled bilinearly by 2 and set to 1 where > 0; (2H, 2W) in {0, 1}."""
    return (upsample_centres(mask[..., None])[..., 0] > 0).astype(mask.dtype)
