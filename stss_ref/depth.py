# SPDX-License-Identifier: MIT
"""Depth in the form that the network and the hole test take."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from stss_ref.arrays import Plane, require, require_choice

DepthMode = Literal["clip", "scale"]
DEPTH_MODES: tuple[DepthMode, ...] = get_args(DepthMode)

BACKGROUND = 1e9
"""A depth of this or more means that nothing was hit (spec 0); so does one that is 0, negative or not finite."""


def normalise_depth(depth: Plane, mode: DepthMode) -> Plane:
    """Take linear view depth to [0, 1].

    ``clip``: ``min(max(d, 0), 1)``. ``scale``: ``(d - min) / (max - min + 1e-6)`` over the frame.

    Source: spec 0.

    Args:
        depth: (H, W) linear view depth; where nothing was hit: 0, negative, non-finite or >= 1e9.
        mode: ``clip`` or ``scale``.

    Returns:
        (H, W) in [0, 1]. Before normalising, the frame's largest real depth (1 if it has none) replaces those where nothing was hit.

    Raises:
        ArrayError: ``depth`` is not (H, W).
    """
    require({"depth": (depth, "H, W")}, non_finite=["depth"])
    require_choice("mode", mode, DEPTH_MODES)

    hit = np.isfinite(depth) & (depth > 0) & (depth < BACKGROUND)
    farthest = depth[hit].max() if hit.any() else depth.dtype.type(1)
    d = np.where(hit, depth, farthest)
    if mode == "clip":
        return np.clip(d, 0, 1)
    return (d - d.min()) / (d.max() - d.min() + d.dtype.type(1e-6))
