# SPDX-License-Identifier: MIT
"""Weights and inputs whose sums are exact in every arithmetic and in any order; and cases in which the sums of one layer round.

Every gate is open: its convolution is 0 and its bias 100, whose sigmoid is 1. Inputs are eighths up to 1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.random import Generator
from numpy.typing import NDArray

from conformance.cases.large_inputs import network_case
from conformance.cases.planes import SEEDS, Size
from conformance.cases.stage_inputs import Inputs
from stss_ref.weights import TENSORS, Weights

Tensors = dict[str, NDArray[Any]]
OPEN = 100.0
ADDED = (1.0, 1.0, -1.0)
"""The weights of one sum: a layer at most doubles its numbers, so that half still has them exactly after the encoder's 11 layers."""
LAST = {"history": "lowlevelGated.conv_feature", "encoder": "conv2.conv_feature", "erm": "latentEncoder.4", "decoder": "outc"}
"""Stage -> the layer whose sums are an output of the stage, without further sums: ``feature``, ``x1``, ``reshaded``, ``image``."""
ROUNDED_SIZE = {"history": (64, 64), "encoder": (16, 16), "erm": (200, 200), "decoder": (16, 16)}
"""(H, W) with thousands of such sums."""
WINDOW = 5
"""Rows and columns of places of which stage erm takes the mean."""


def tap_weights(rng: Generator, taps: tuple[float, ...], biases: tuple[float, ...] = (0.0,)) -> Tensors:
    """Weights with which every output of a layer is a sum of a few inputs, each times one of ``taps``, and of one of ``biases``."""
    tensors: Tensors = {}
    for name, shape in TENSORS.items():
        tensor = np.zeros(shape, np.float32)
        if "conv_mask" in name:
            tensor += OPEN if name.endswith("bias") else 0
        elif name.endswith("bias"):
            tensor = rng.choice(biases, shape).astype(np.float32)
        else:
            flat = tensor.reshape(shape[0], -1)
            for row in flat:
                row[rng.choice(row.size, len(taps), replace=False)] = taps[: row.size]
        tensors[name] = tensor
    return tensors


def eighths(stage: str, rng: Generator, size: Size) -> Inputs:
    """Inputs of a stage of the network: eighths in [0, 1], and masks of 0 and 1."""
    inputs, _ = network_case(stage, size, rng)
    return {name: np.round(array * 8) / 8 if name != "mask" else array for name, array in inputs.items()}


@st.composite
def exact_inputs(draw: st.DrawFn, stage: str, size: st.SearchStrategy[Size]) -> tuple[Inputs, Weights]:
    """Draw a case whose computation needs no rounding."""
    rng = np.random.default_rng(draw(SEEDS))
    inputs, weights = eighths(stage, rng, draw(size)), tap_weights(rng, ADDED, (-1.0, 0.0, 1.0))
    if stage == "decoder":
        # Interpolation is exact only in a flat image, so enlarged features are flat up to the last layers.
        inputs |= {name: np.broadcast_to(inputs[name][:1, :1], inputs[name].shape) for name in inputs if name != "x1"}
        for name, tensor in weights.items():
            if name.startswith(("up1", "up2")) and name.endswith("weight"):
                weights[name] = _centre(tensor)
    return inputs, Weights(weights)


def _centre(tensor: NDArray[Any]) -> NDArray[Any]:
    """The tensor with the sum of a layer's taps in the middle of its window."""
    centred = np.zeros_like(tensor)
    centred[:, :, 1, 1] = tensor.sum(axis=(2, 3))
    return centred


@st.composite
def rounded_sums(draw: st.DrawFn, stage: str) -> tuple[Inputs, Weights]:
    """Draw a case in which only the layer of ``LAST`` rounds: the layers before it copy one input to each output.

    Its products have one sign, and none or half of them are 0, so that a sum that always rounds to one side ends far from the truth.
    """
    rng = np.random.default_rng(draw(SEEDS))
    inputs, weights = eighths(stage, rng, ROUNDED_SIZE[stage]), tap_weights(rng, (1.0,))
    if draw(st.booleans()):
        inputs = {name: array * (rng.random(array.shape) < 0.5) for name, array in inputs.items()}
    if stage == "decoder":
        inputs = {name: array * (name == "x1") for name, array in inputs.items()}
        _copy_x1(weights)
    if stage == "erm":
        _trust_one_of_each_window(inputs, weights)
    name = f"{LAST[stage]}.weight"
    # A ReLU follows the encoder's layer.
    sign = 1.0 if stage == "encoder" else draw(st.sampled_from([1.0, -1.0]))
    weights[name] = (rng.uniform(0, 1, weights[name].shape) * sign).astype(np.float32)
    return inputs, Weights(weights)


def _copy_x1(weights: Tensors) -> None:
    """Make ``up3`` copy ``x1``, the first of its inputs, so that the decoder's last layer reads ``x1`` itself."""
    for name in ("up3.conv.double_conv.0.weight", "up3.conv.double_conv.2.weight"):
        weights[name] = np.zeros_like(weights[name])
        weights[name][range(24), range(24), 1, 1] = 1


def _trust_one_of_each_window(inputs: Inputs, weights: Tensors) -> None:
    """Make each result of stage erm the light of one place: the only one in its window that is trusted. All keys are 1."""
    y, x = np.indices(inputs["mask"].shape) // 8 % WINDOW
    inputs["mask"] = ((y == WINDOW // 2) & (x == WINDOW // 2)).astype(np.float64)
    for name in weights:
        if name.startswith("KEncoder"):
            weights[name] = np.zeros_like(weights[name])
    weights["KEncoder.4.bias"][0] = 1
