# SPDX-License-Identifier: MIT
"""One step of training: the loss of a batch, its gradient, the optimisers, and the running mean of the weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor, nn

from training.checkpoint import State
from training.loss import STRUCTURE, by_kind, loss, squared, structure, supervision, trusted, unsteadiness
from training.network import Heads, Network, base, leak

CLIP = 1.0
"""Largest norm of a step's gradient."""
ADAM = 0.05
"""Adam's rate / Muon's rate; Muon's steps are scaled per layer, Adam's per number."""
LEAK = 0.1
"""Slope of the ReLUs for negative numbers at step 0 of a run from random weights."""
AVERAGE = 0.999
"""Share of the running mean that a step keeps, after enough steps."""


@dataclass(frozen=True)
class Aims:
    """The aims of a step, and their weights; constant in a run but for ``young``.

    Attributes:
        half: whether the network computes in bfloat16.
        young: the share of the aids for a beginner, see `infancy`.
        squares: the squared error's share of the loss.
        similar: the factor of 1 - SSIM, in SFs and in EFs.
        extrapolated, holes: see `training.loss.squared`.
        steady: the factor of `training.loss.unsteadiness`.
    """

    half: bool = False
    young: float = 0.0
    squares: float = 0.0
    similar: tuple[float, float] = (STRUCTURE, STRUCTURE)
    extrapolated: float = 0.5
    holes: float = 1.0
    steady: float = 0.0


def advance(state: State, batch: tuple[Tensor, ...], rate: float, aims: Aims, *, compiled: bool = False) -> Tensor:
    """One step; with ``compiled`` by compiled code, but for a beginner's, whose ReLUs change with every step.

    Returns the loss, on the device.
    """
    leak(state.network, LEAK * aims.young)
    enlarged, trust = base(batch[0]), trusted(batch[2])
    value = (compile_objective() if compiled and not aims.young else objective)(
        state.network, state.heads, batch, enlarged, trust, aims
    )
    return descend(state, value, rate)


def descend(state: State, value: Tensor, rate: float) -> Tensor:
    """Make the loss smaller by one step of the optimisers, and move the running mean; returns the loss."""
    for optimiser, factor in zip(state.optimisers, (1.0, ADAM), strict=True):
        for group in optimiser.param_groups:
            group["lr"] = rate * factor
    value.backward()
    nn.utils.clip_grad_norm_(state.network.parameters(), CLIP)
    for optimiser in state.optimisers:
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)
    state.step += 1
    keep = min(AVERAGE, state.step / (state.step + 10))
    with torch.no_grad():
        for name, tensor in state.network.named_parameters():
            state.average[name].lerp_(tensor, 1 - keep)
    return value.detach()


def objective(network: Network, heads: Heads, batch: tuple[Tensor, ...], enlarged: Tensor, trust: Tensor, aims: Aims) -> Tensor:
    """The loss of a batch.

    Args:
        network: is trained.
        heads: aids for a beginner.
        batch: color, gbuffer, mask, history, truth, motion, see `training.augment.Batch`.
        enlarged: the colour at twice the size, `training.network.base`.
        trust: where the mask is above 0 at twice the size, `training.loss.trusted`.
        aims: see there.
    """
    color, gbuffer, mask, history, truth, motion = batch
    with torch.autocast(color.device.type, torch.bfloat16, enabled=aims.half):
        residual, features = network.residual(color, gbuffer, mask, history)
        pictures = heads(features) if aims.young else []
    output, squares = residual.float() + enlarged, max(aims.young, aims.squares)
    value = (1 - squares) * loss(output, truth, trust, by_kind(structure(output, truth), *aims.similar))
    if squares:
        value = value + squares * squared(output, truth, aims.extrapolated, trust, aims.holes)
    if aims.steady:
        value = value + aims.steady * unsteadiness(output - truth, motion)
    if aims.young:
        value = value + aims.young * supervision([p.float() for p in pictures], truth)
    return value


@cache
def compile_objective() -> Callable[..., Tensor]:
    """`objective`, compiled for one shape of batch: the work between the convolutions takes half the time."""
    return torch.compile(objective, dynamic=False)
