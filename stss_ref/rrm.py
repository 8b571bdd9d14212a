# SPDX-License-Identifier: MIT
"""Stage rrm: Random Reshading Masking, the training augmentation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stss_ref.arrays import Array, ArrayError, Mask, require, require_shape


def rrm(valid: Mask | Array, rectangle: tuple[int, int, int, int]) -> Mask | Array:
    """Declare one rectangle of the mask to be a hole.

    Source: spec 6; paper, Random Reshading Masking.

    Args:
        valid: (H, W) 1 = to be trusted.
        rectangle: y, x, height, width; pixels, within the frame.

    Returns:
        (H, W), ``valid`` with the rectangle set to 0, in its dtype.

    Raises:
        ArrayError: the rectangle does not lie within the frame.
    """
    require({"valid": (valid, "H, W")}, masks=["valid"])
    height, width = valid.shape
    require_shape("rectangle", np.asarray(rectangle), (4,))
    y, x, h, w = (int(v) for v in rectangle)
    if not (0 <= y <= y + h <= height and 0 <= x <= x + w <= width):
        raise ArrayError(f"rectangle: expected to lie within {height} x {width}, got y={y}, x={x}, h={h}, w={w}")

    masked = valid.copy()
    masked[y : y + h, x : x + w] = 0
    return masked


def draw_rectangle(height: int, width: int, random: np.random.Generator) -> tuple[int, int, int, int]:
    """Draw the rectangle of one training sample.

    ``h0`` uniform in ``1..H/4``, ``w0`` uniform in ``1..min(H W / (16 h0), W/4)``, integer division; the corner uniform over the
    places where it fits.

    Source: spec 6.

    Args:
        height, width: of the mask, at least 4 each.
        random: the source of the draws.

    Returns:
        y, x, height, width.

    Raises:
        ArrayError: the mask is smaller than 4 x 4.
    """
    if height < 4 or width < 4:
        raise ArrayError(f"rrm: expected a mask of at least 4 x 4, got {height} x {width}")

    h = int(random.integers(1, height // 4, endpoint=True))
    w = int(random.integers(1, min(height * width // (16 * h), width // 4), endpoint=True))
    y = int(random.integers(0, height - h, endpoint=True))
    x = int(random.integers(0, width - w, endpoint=True))
    return y, x, h, w


def concat_masked(color: Array, mask: Array) -> NDArray[np.floating]:
    """``color`` (H, W, C) followed by ``color * mask``: (H, W, 2C), the form in which the network takes both (spec 6, 7)."""
    return np.concatenate([color, color * mask[..., None]], axis=-1)
