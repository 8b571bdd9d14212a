# SPDX-License-Identifier: MIT
"""Depth as the network and the hole test see it."""

from __future__ import annotations

from typing import Literal

import numpy as np

from stss_ref.arrays import Plane, require_shape

DepthMode = Literal["clip", "scale"]

BACKGROUND = 1e9
"""Depths from here on mean that nothing was hit (spec 0); so do 0, negative and non-finite ones."""


def normalise_depth(depth: Plane, mode: DepthMode) -> Plane:
    """Linear view depth taken to [0, 1].

    ``clip``: ``min(max(d, 0), 1)``. ``scale``: ``(d - min) / (max - min + 1e-6)`` over the frame.

    Source: spec 0.

    Args:
        depth: (H, W) linear view depth; where nothing was hit: 0, negative, non-finite or >= 1e9.
        mode: ``clip`` or ``scale``.

    Returns:
        (H, W) in [0, 1]; where nothing was hit, the largest real depth stands in (1, before it is normalised, in a frame that has none).
    """
    require_shape("depth", depth, (None, None))

    hit = np.isfinite(depth) & (depth > 0) & (depth < BACKGROUND)
    farthest = depth[hit].max() if hit.any() else depth.dtype.type(1)
    d = np.where(hit, depth, farthest)
    if mode == "clip":
        return np.clip(d, 0, 1)
    return (d - d.min()) / (d.max() - d.min() + d.dtype.type(1e-6))
