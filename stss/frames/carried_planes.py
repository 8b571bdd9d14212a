# SPDX-License-Identifier: MIT
"""Planes that do not go through the network: highlights above 1, alpha, passes. They are warped and enlarged like the frame's colour."""

from __future__ import annotations

import numpy as np

from stss.images.color import LARGEST
from stss_ref.arrays import Array, Image
from stss_ref.resample import upsample_centres
from stss_ref.warp import warp

HIGHLIGHTS = "\0highlights"
"""Name of the plane with the part of the colour above 1. No channel has it: names in files end at a NUL."""
WHITE = (0.85, 0.95)
"""Display-referred: a pixel below the first value has no highlight, one above the second has the whole of it. If a bright sky is behind
leaves, the enlarged highlight covers them too; the network's image then tells sky from leaves (decision 7)."""


def highlights(color: Image) -> Image | None:
    """The part above 1 of a scene-linear colour (H, W, 3), at most `LARGEST`; None where no pixel has any. NaN counts as 0."""
    if not (color > 1).any():  # NaN compares as False
        return None
    # fmax takes the number where the other one is NaN
    return (np.fmax(np.minimum(color, LARGEST), 1) - 1).astype(np.float32, copy=False)


def add_highlights(color: Image, image: Image, above: Image) -> None:
    """Give the white pixels of a frame their highlights.

    Args:
        color: (H, W, 3) float32, contiguous, scene-linear, in [0, 1]; changed in place, to at most `LARGEST`.
        image: (H, W, 3) the same, display-referred.
        above: (H, W, 3) the plane `HIGHLIGHTS`, as `carry` made it.
    """
    at = np.flatnonzero(above > 0)
    low, high = WHITE
    share = np.clip((image.reshape(-1)[at] - low) / (high - low), 0, 1)
    color.reshape(-1)[at] += above.reshape(-1)[at] * share


def carry(plane: Array, motion: Image | None) -> Image:
    """Bring a plane of the newest rendered frame to the size and time of the output.

    Args:
        plane: (H, W, C).
        motion: (H, W, 2) that leads from the display frame to the rendered one; None: they are the same frame.

    Returns:
        (2H, 2W, C).
    """
    return upsample_centres(plane if motion is None else warp(plane, motion)[0])
