# SPDX-License-Identifier: MIT
"""The inputs of `stss stress`.

Inputs are noise: nothing is flat or still. The inputs of a later stage are the outputs of earlier ones in float64, rounded to float32, so
that they have the same magnitude as in a frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.protocol.port import Arrays
from stss_lab.stress.engines import features_of
from stss_ref.weights import Weights

MASKED = 0.2
"""Share of the pixels that are holes."""
REACH = 3.0
"""Longest motion in each direction; pixels."""
UNSCALED = ("mask", "valid", "depth", "nov", "stencil", "stencil_previous", "normal", "normal_previous")
"""Inputs that are not scaled, since their range is fixed by definition."""

Inputs = dict[str, NDArray[Any]]


def frame_noise(seed: int, height: int, width: int) -> Inputs:
    """Inputs of stage ``network``: colours and materials in [0, 1], normals of unit length, a fifth of the masks 0."""
    random = np.random.default_rng(seed)
    normal = random.standard_normal((height, width, 3))
    normal /= np.sqrt((normal * normal).sum(axis=-1, keepdims=True))
    gbuffer = np.concatenate([normal, random.random((height, width, 6))], axis=-1)
    history = random.random((3, height, width, 4))
    history[..., 3] = random.random((3, height, width)) >= MASKED
    mask = random.random((height, width)) >= MASKED
    arrays = {"color": random.random((height, width, 6)), "gbuffer": gbuffer, "mask": mask, "history": history}
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def image_noise(seed: int, height: int, width: int) -> dict[str, Inputs]:
    """Inputs of the image-space stages except ``holes``: noise that moves by up to ``REACH``."""
    random = np.random.default_rng(seed + 1000)
    motions = random.uniform(-REACH, REACH, (3, height, width, 2)).astype(np.float32)
    color, warped = random.random((2, height, width, 3)).astype(np.float32)
    depth = random.random((height, width)).astype(np.float32)
    valid = (random.random((height, width)) >= MASKED).astype(np.uint8)
    return {
        "warp": {"color": color, "motion": motions[0]},
        "motion_chain": {"motions": motions},
        "occlusion_warp": {"color": color, "warped": warped, "motion": motions[0], "depth": depth, "valid": valid},
    }


def stage_inputs(seed: int, height: int, width: int, weights: Weights) -> dict[str, Inputs]:
    """Stage -> inputs, float32, of each stage with weights."""
    frame = frame_noise(seed, height, width)
    features = {name: array.astype(np.float32) for name, array in features_of(exact(frame), weights).items()}
    return {
        "history": {"history": frame["history"]},
        "encoder": {name: frame[name] for name in ("color", "gbuffer", "mask")},
        "erm": {"x4": features["x4"], "gbuffer": frame["gbuffer"], "mask": frame["mask"]},
        "decoder": {name: features[name] for name in ("reshaded", "feature", "x1", "x2", "x3")} | {"color": frame["color"]},
        "network": frame,
    }


def exact(inputs: Arrays) -> Inputs:
    """The same numbers in float64; masks of integers stay."""
    return {name: array.astype(np.float64) if array.dtype.kind == "f" else array for name, array in inputs.items()}


def scale(stage: str, inputs: Arrays, by: float) -> Inputs:
    """Inputs ``by`` times as large, rounded to float32, except those in `UNSCALED`. Motion is scaled only where it is the only input."""
    unscaled = (*UNSCALED, "motion") if stage != "motion_chain" else UNSCALED
    result = {n: a if n in unscaled or a.dtype.kind != "f" else (a * float(by)).astype(np.float32) for n, a in inputs.items()}
    if stage in ("history", "network"):
        result["history"][..., 3] = inputs["history"][..., 3]
    return result


def scale_weights(weights: Weights, by: float) -> Weights:
    """All tensors, ``by`` times as large."""
    return weights | {n: (w * np.float32(by)).astype(np.float32) for n, w in weights.items()}
