# SPDX-License-Identifier: MIT
"""Stage accumulate: a display frame's image and those of the two frames before it, in one that flickers less."""

from __future__ import annotations

import numpy as np

from stss_ref.arrays import Array, ArrayError, Image, require
from stss_ref.constants import EARLIER_SHARES, SLOW
from stss_ref.warp import warp


def accumulate(image: Image, earlier: Array, motions: Array) -> Image:
    """Mix an image with those of the one or two display frames before it.

    ``shown(p) = image(p) + w_1(p)/4 (c_1(p) - image(p)) + w_2(p)/8 (c_2(p) - image(p))``. ``c_k(p)`` is ``clamp(warp(earlier_k)(p),
    box(p))`` where the motion ``m_k`` to that frame leads into it, else ``image(p)``, and so without a second one. ``w_k = min(1, 16 /
    |m_k|^2)``: less beyond a motion of 4 pixels. ``box(p)``: the smallest and the largest value of each channel of ``image``
    in the 3 x 3 pixels around ``p`` that lie in the frame. A display pixel lies in a pixel, and has twice its motion and the same ``w``.

    Source: Karis, High Quality Temporal Supersampling, SIGGRAPH 2014; ours: decision 45.

    Args:
        image: (2H, 2W, C) of stage ``frame``; finite.
        earlier: (k, 2H, 2W, C) of stage ``frame`` too, of the one or two display frames before, newest first; finite.
        motions: (k, H, W, 2) from the frame to each of them (stage ``motion_chain``), pixels; non-finite is off screen.

    Returns:
        shown: (2H, 2W, C) as ``image``, within ``box``.

    Raises:
        ArrayError: shapes or dtypes differ, an image is not finite, or there are more than two.
    """
    sizes = require(
        {"motions": (motions, "k, H, W, 2"), "image": (image, "2H, 2W, C"), "earlier": (earlier, "k, 2H, 2W, C")},
        non_finite=["motions"],
    )
    if sizes["k"] > len(EARLIER_SHARES):
        raise ArrayError(f"earlier: expected at most {len(EARLIER_SHARES)} images, got {sizes['k']}")

    low, high = box(image)
    total = np.zeros_like(image)
    for then, motion, share in zip(earlier, motions, EARLIER_SHARES, strict=False):
        # A sum of differences and not of images: images at rest stay, bit for bit.
        total = total + _apart(image, then, motion, low, high) * share
    return image + total


def _apart(image: Image, earlier: Image, motion: Image, low: Image, high: Image) -> Image:
    """``w_k (c_k - image)``; 0 where the motion does not lead into the frame."""
    history, inside = warp(earlier, _to_display(2 * motion))
    return np.where(inside[..., None], (np.clip(history, low, high) - image) * _to_display(slowness(motion)), 0)


def _to_display(plane: Image) -> Image:
    return plane.repeat(2, axis=0).repeat(2, axis=1)


def slowness(motion: Image) -> Image:
    """``min(1, 16 / |m|^2)``, (H, W, 1), of motion (H, W, 2) in pixels; NaN where it is."""
    with np.errstate(over="ignore"):  # of a motion that leads far out of the frame
        return SLOW**2 / np.maximum(np.square(motion).sum(axis=-1, keepdims=True), SLOW**2)


def box(image: Image) -> tuple[Image, Image]:
    """(H, W, C) smallest and largest value of the 3 x 3 pixels of (H, W, C) around each pixel, as far as they lie in the frame."""
    low = high = image
    for axis, length in enumerate(image.shape[:2]):  # along one axis, then along the other: three copies in place of nine
        near = [np.clip(np.arange(length) + step, 0, length - 1) for step in (-1, 0, 1)]
        low = np.minimum.reduce([low.take(at, axis) for at in near])
        high = np.maximum.reduce([high.take(at, axis) for at in near])
    return low, high
