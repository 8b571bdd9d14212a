# SPDX-License-Identifier: MIT
"""The inputs of `stss stress`, and weights that make the same sums in another order.

Inputs are noise: nothing is flat or still. The inputs of a later stage are the outputs of earlier ones in float64, rounded to float32, so
that they have the magnitude that they have in a frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.protocol.port import Arrays
from stss_lab.stress.engines import features_of
from stss_ref.arrays import Array
from stss_ref.weights import LAYERS, Weights

MASKED = 0.2
"""Share of the pixels that are holes."""
REACH = 3.0
"""Longest motion in each direction; pixels."""
UNSCALED = ("mask", "valid", "depth", "nov", "stencil", "stencil_previous", "normal", "normal_previous")
"""Inputs that are not scaled, since their range is fixed by definition."""

Given = dict[str, NDArray[Any]]


def frame_noise(seed: int, height: int, width: int) -> Given:
    """Inputs of stage ``network``: colours and materials in [0, 1], normals of unit length, a fifth of the masks 0."""
    random = np.random.default_rng(seed)
    normal = random.standard_normal((height, width, 3))
    normal /= np.sqrt((normal * normal).sum(axis=-1, keepdims=True))
    gbuffer = np.concatenate([normal, random.random((height, width, 6))], axis=-1)
    history = random.random((3, height, width, 4))
    history[..., 3] = random.random((3, height, width)) >= MASKED
    mask = random.random((height, width)) >= MASKED
    given = {"color": random.random((height, width, 6)), "gbuffer": gbuffer, "mask": mask, "history": history}
    return {name: array.astype(np.float32) for name, array in given.items()}


def image_noise(seed: int, height: int, width: int) -> dict[str, Given]:
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


def stage_inputs(seed: int, height: int, width: int, weights: Weights) -> dict[str, Given]:
    """Stage -> inputs, float32, of each stage with weights."""
    frame = frame_noise(seed, height, width)
    made = {name: array.astype(np.float32) for name, array in features_of(exact(frame), weights).items()}
    return {
        "history": {"history": frame["history"]},
        "encoder": {name: frame[name] for name in ("color", "gbuffer", "mask")},
        "erm": {"x4": made["x4"], "gbuffer": frame["gbuffer"], "mask": frame["mask"]},
        "decoder": {name: made[name] for name in ("reshaded", "feature", "x1", "x2", "x3")} | {"color": frame["color"]},
        "network": frame,
    }


def exact(inputs: Arrays) -> Given:
    """The same numbers in float64; masks of integers stay."""
    return {name: array.astype(np.float64) if array.dtype.kind == "f" else array for name, array in inputs.items()}


def scaled(stage: str, inputs: Arrays, by: float) -> Given:
    """Inputs ``by`` times as large, rounded to float32, except those in `UNSCALED`. Motion is scaled only where it is the only input."""
    unscaled = (*UNSCALED, "motion") if stage != "motion_chain" else UNSCALED
    result = {n: a if n in unscaled or a.dtype.kind != "f" else (a * float(by)).astype(np.float32) for n, a in inputs.items()}
    if stage in ("history", "network"):
        result["history"][..., 3] = inputs["history"][..., 3]
    return result


def scaled_weights(weights: Weights, by: float, prefix: str = "") -> Weights:
    """The tensors whose names begin with ``prefix``, ``by`` times as large; the others as they are."""
    return weights | {n: (w * np.float32(by)).astype(np.float32) for n, w in weights.items() if n.startswith(prefix)}


def _inner_edges() -> list[tuple[str, tuple[str, ...], int]]:
    """``(layer, the layers that read it, its first channel there)``, where both belong to one stage."""
    edges: list[tuple[str, tuple[str, ...], int]] = [("conv1", ("conv2",), 0)]
    for name in ("down1", "down2", "down3"):
        edges += [(f"{name}.downsample", (f"{name}.conv1",), 0), (f"{name}.conv1", (f"{name}.conv2",), 0)]
    chain = [f"convHis{i}.{j}" for i in (1, 2, 3) for j in (0, 2, 4)]
    edges += [(a, (b,), 0) for a, b in pairwise(chain)]
    for name in ("latentEncoder", "KEncoder"):
        edges += [(f"{name}.0", (f"{name}.2",), 0), (f"{name}.2", (f"{name}.4",), 0)]
    edges.append(("KEncoder.4", (), 0))  # the attention sums over its channels
    ups = [f"up{i}.conv.double_conv" for i in (1, 2, 3)]
    edges += [(f"{name}.0", (f"{name}.2",), 0) for name in ups]
    # The decoder's skip comes first in what the next level reads.
    return [*edges, (f"{ups[0]}.2", (f"{ups[1]}.0",), 24), (f"{ups[1]}.2", (f"{ups[2]}.0",), 24), (f"{ups[2]}.2", ("outc",), 0)]


def permuted(weights: Weights, seed: int) -> Weights:
    """A network that computes the same function with its inner channels, and so the sums over them, in another order.

    Channels that cross from one stage to another keep their place, so that the outputs of every stage can be compared.
    """
    random = np.random.default_rng(seed)
    result = {name: np.array(tensor) for name, tensor in weights.items()}
    outputs = {layer.name: layer.outputs for layer in LAYERS}
    for layer, readers, first in _inner_edges():
        order = random.permutation(outputs[layer])
        made = f"{layer}.conv_feature" if f"{layer}.conv_feature.weight" in result else layer
        for part in ("weight", "bias"):
            result[f"{made}.{part}"] = result[f"{made}.{part}"][order]
        for name in [n for reader in readers for n in result if n.startswith(f"{reader}.") and n.endswith("weight")]:
            result[name][:, first : first + len(order)] = result[name][:, first + order]
    last = (
        np.tile(np.arange(32), 3).reshape(3, 32) + 32 * np.arange(3)[:, None]
    )  # convHis3.4 is read three times, once for each frame
    order = random.permutation(32)
    for part in ("weight", "bias"):
        result[f"convHis3.4.{part}"] = result[f"convHis3.4.{part}"][order]
    for name in ("lowlevelGated.conv_feature.weight", "lowlevelGated.conv_mask.0.weight"):
        result[name] = result[name][:, last[:, order].ravel()]
    return weights | result


def transposed(weights: Weights) -> Weights:
    """The network for frames with rows and columns exchanged: every sum over a window then runs in the other order."""
    result = weights.convert(lambda w: np.ascontiguousarray(w.swapaxes(2, 3)) if w.ndim == 4 else w)
    exchanged = np.arange(12).reshape(3, 2, 2).swapaxes(1, 2).ravel()
    return result | {f"outc.{part}": result[f"outc.{part}"][exchanged] for part in ("weight", "bias")}


def transposed_arrays(arrays: Mapping[str, Array]) -> Given:
    """Inputs or outputs of a stage with weights, rows and columns exchanged."""
    return {n: np.ascontiguousarray(a.swapaxes(-3, -2) if n != "mask" else a.T) for n, a in arrays.items()}
