# SPDX-License-Identifier: MIT
"""Weights and inputs whose sums no arithmetic rounds, in any order; and one layer at a time whose sums round.

Every gate is open: its convolution is 0, its bias 100, and the sigmoid of that is 1. Inputs are eighths up to 1.
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
"""The weights of one sum: a layer at most doubles its numbers, so that after the encoder's eleven half still holds them."""
LAST = {"history": "lowlevelGated.conv_feature", "encoder": "conv2.conv_feature", "decoder": "outc"}
"""A layer whose sums are an output of the stage, with nothing computed behind them: ``feature``, ``x1``, ``image``."""


def tapped(rng: Generator, taps: tuple[float, ...], biases: tuple[float, ...] = (0.0,)) -> Tensors:
    """Every output of a layer is a sum of few of its inputs, each times one of ``taps``, and one of ``biases``."""
    made: Tensors = {}
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
        made[name] = tensor
    return made


def eighths(stage: str, rng: Generator, size: Size) -> Inputs:
    """Inputs of a stage of the network: eighths in [0, 1], masks of 0 and 1."""
    inputs, _ = network_case(stage, size, rng)
    return {name: np.round(array * 8) / 8 if name != "mask" else array for name, array in inputs.items()}


@st.composite
def exact_inputs(draw: st.DrawFn, stage: str, size: st.SearchStrategy[Size]) -> tuple[Inputs, Weights]:
    """A case that is computed without one rounding."""
    rng = np.random.default_rng(draw(SEEDS))
    inputs, given = eighths(stage, rng, draw(size)), tapped(rng, ADDED, (-1.0, 0.0, 1.0))
    if stage == "decoder":
        # Between two pixels nothing is exact but a flat image: what is enlarged is flat, and stays so up to the last layers.
        inputs |= {name: np.broadcast_to(inputs[name][:1, :1], inputs[name].shape) for name in inputs if name != "x1"}
        for name, tensor in given.items():
            if name.startswith(("up1", "up2")) and name.endswith("weight"):
                given[name] = _centred(tensor)
    return inputs, given


def _centred(tensor: NDArray[Any]) -> NDArray[Any]:
    """All of a layer's taps at the middle of its window."""
    centred = np.zeros_like(tensor)
    centred[:, :, 1, 1] = tensor.sum(axis=(2, 3))
    return centred


@st.composite
def rounded_sums(draw: st.DrawFn, stage: str) -> tuple[Inputs, Weights]:
    """A case in which one layer alone rounds, the one of ``LAST``: before it one input is copied to each output.

    Its products are dense or half of them 0, of one sign, so that a sum that rounds one way ends far from the truth.
    """
    rng = np.random.default_rng(draw(SEEDS))
    inputs, given = eighths(stage, rng, (64, 64) if stage == "history" else (16, 16)), tapped(rng, (1.0,))
    if draw(st.booleans()):
        inputs = {name: array * (rng.random(array.shape) < 0.5) for name, array in inputs.items()}
    if stage == "decoder":
        inputs = {name: array * (name == "x1") for name, array in inputs.items()}
        _copy_x1(given)
    name = f"{LAST[stage]}.weight"
    # A ReLU is behind the encoder's.
    sign = 1.0 if stage == "encoder" else draw(st.sampled_from([1.0, -1.0]))
    given[name] = (rng.uniform(0, 1, given[name].shape) * sign).astype(np.float32)
    return inputs, given


def _copy_x1(given: Tensors) -> None:
    """``x1`` to the decoder's last layer as it is: it comes first in what ``up3`` reads."""
    for name in ("up3.conv.double_conv.0.weight", "up3.conv.double_conv.2.weight"):
        given[name] = np.zeros_like(given[name])
        given[name][range(24), range(24), 1, 1] = 1
