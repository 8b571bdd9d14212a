# SPDX-License-Identifier: MIT
"""Stage accumulate: the display frame and the one shown before it, in one image that flickers less."""

from __future__ import annotations

import numpy as np

from stss_ref.arrays import Image, require
from stss_ref.constants import EARLIER_SHARE
from stss_ref.sample import lerp
from stss_ref.warp import warp


def accumulate(image: Image, before: Image, motion: Image) -> Image:
    """Mix a display frame with the one shown before it.

    ``shown(p) = image(p) + (clamp(warp(before)(p), box(p)) - image(p)) 3 / 8`` where the motion leads into the frame, else ``image(p)``.
    ``box(p)``: the smallest and the largest value of each channel of ``image`` in the 3 x 3 pixels around ``p`` that lie in the frame.
    A display pixel has twice the motion of the pixel that it lies in.

    Source: Karis, High Quality Temporal Supersampling, SIGGRAPH 2014; ours: decision 45.

    Args:
        image: (2H, 2W, C) of stage ``frame``; finite.
        before: (2H, 2W, C) the image shown for the display frame before: an earlier result, or the first frame's ``image``; finite.
        motion: (H, W, 2) the display frame's own, pixels, current -> previous; non-finite is off screen.

    Returns:
        shown: (2H, 2W, C) as ``image``, within ``box``.

    Raises:
        ArrayError: shapes or dtypes differ, or an image is not finite.
    """
    require(
        {"motion": (motion, "H, W, 2"), "image": (image, "2H, 2W, C"), "before": (before, "2H, 2W, C")}, non_finite=["motion"]
    )

    moved = (2 * motion).repeat(2, axis=0).repeat(2, axis=1)
    low, high = box(image)
    history, inside = warp(before, moved)
    return np.where(inside[..., None], lerp(image, np.clip(history, low, high), EARLIER_SHARE), image)


def box(image: Image) -> tuple[Image, Image]:
    """(H, W, C) smallest and largest value of the 3 x 3 pixels of (H, W, C) around each pixel, as far as they lie in the frame."""
    low = high = image
    for axis, length in enumerate(image.shape[:2]):  # along one axis, then along the other: three copies in place of nine
        near = [np.clip(np.arange(length) + step, 0, length - 1) for step in (-1, 0, 1)]
        low = np.minimum.reduce([low.take(at, axis) for at in near])
        high = np.maximum.reduce([high.take(at, axis) for at in near])
    return low, high
