# SPDX-License-Identifier: MIT
"""The weights at the start of a run, and those that stay fixed."""

from __future__ import annotations

import math

import torch
from torch import nn

from stss_ref.weights import LAYERS
from training.network import HISTORY, Network

OUTC = 0.05
"""Gain of the last layer at the start."""


def initialise(network: nn.Module, seed: int) -> None:
    """He's initialisation with biases of 0, gates half open, and a small ``outc``: training starts near ``bilinear``.

    ``outc`` does not start at 0: only noise would then reach the layers before it, and Adam scales noise up to full steps. In this way
    the history's gates closed for ever, before there was anything to learn.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, tensor in network.named_parameters():
            if name.endswith("bias"):
                tensor.zero_()
            else:
                # A half-open gate halves its feature, so the feature's weights are doubled.
                gain = (
                    2.0
                    if ".conv_feature." in name
                    else 0.1
                    if ".conv_mask." in name
                    else OUTC
                    if name.startswith("outc")
                    else 1.0
                )
                deviation = gain * math.sqrt(2 / math.prod(tensor.shape[1:]))
                tensor.copy_(torch.randn(tensor.shape, generator=generator) * deviation)


def hold_gates(network: Network) -> None:
    """Hold the gate of the history open (0.95 everywhere), and do not train it.

    While the history's features are still noise, the quickest way to a smaller loss is to close the one gate that they all pass. A closed
    gate passes no gradient and never opens again. Three runs in a row lost the history in this way.
    """
    mask = network.get_submodule(f"{HISTORY}.conv_mask.0")
    with torch.no_grad():
        mask.weight.zero_()
        mask.bias.fill_(3.0)
    mask.requires_grad_(False)


def hold_history(network: Network) -> None:
    """Make the features of the history independent of it: set its kernels to 0, and do not train them.

    Weights that are trained this way give the same result with any history, and an implementation can tell from the zeros
    that it need not read the history.
    """
    with torch.no_grad():
        for layer in (layer for layer in LAYERS if layer.component == "history"):
            weight = network.get_parameter(f"{layer.name}{'.conv_feature' if layer.gated else ''}.weight")
            weight.zero_()
            weight.requires_grad_(False)


def forget_second_color(network: Network) -> None:
    """Move the first layer's kernels of the second colour to the first, while both colours are the same; those of the second become 0.

    The image of an SF then stays as it is when the second colour becomes another; from there training goes on.
    """
    with torch.no_grad():
        for convolution in (network.conv1.conv_feature, network.conv1.conv_mask[0]):
            for first in (0, 6):  # the colours, and the colours times the mask
                second = convolution.weight[:, first + 3 : first + 6]
                convolution.weight[:, first : first + 3] += second
                second.zero_()
