# SPDX-License-Identifier: MIT
"""The training loss of spec section 6, and the perceptual term of our choice.

The perceptual term is structural similarity (Wang 2004) of the luma, over windows of 7 x 7 at three scales. It needs no
trained network, so nothing is downloaded and nobody's licence is inherited; it compares what the eye does (structure
relative to the local contrast), where L1 is content with a blur; and the mix of the two is known to beat either alone,
also by the measures of the other (Zhao et al. 2017, Loss Functions for Image Restoration with Neural Networks).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

PERCEPTUAL = 0.01
"""Weight of the perceptual term (spec 6)."""
STRUCTURE = 25.0
"""The perceptual distance is so many times 1 - SSIM: with the 0.01 of spec 6, as much as L1 on aliased frames, SSIM about 0.8."""
SCALES = 3
WINDOW, STRIDE = 7, 3
"""Windows overlap, but not every one is looked at: that would be a sixth of a step's time on a CPU."""
LUMA = (0.299, 0.587, 0.114)


def loss(output: Tensor, truth: Tensor, mask: Tensor, perceptual: Tensor | float) -> Tensor:
    """L1 over the pictures, once more over the reshading regions, and the perceptual term.

    ``mean |o - y| + sum |o - y| (1 - M) / max(sum (1 - M), 1e-6) + 0.01 perceptual``

    The sums run over the batch as over one large picture: were each sample divided by its own holes, a hole of one pixel
    would weigh as much as a frame.

    Source: spec 6.

    Args:
        output, truth: (N, 3, 2H, 2W) display-referred.
        mask: (N, 1, H, W) 1 = to be trusted, RRM's rectangle included.
        perceptual: the perceptual distance, see `structure`.
    """
    return _weighted((output - truth).abs(), mask) + PERCEPTUAL * perceptual


SQUARES = 20.0
"""Squared errors of some 0.002 weigh as much as L1's of 0.03."""


def squared(output: Tensor, truth: Tensor) -> Tensor:
    """The mean squared error, for the start of a run and for PSNR's sake.

    L1 pulls with the same force however small an error is: a residual that is right at edges and noise elsewhere shrinks to 0
    everywhere, and from 0 the network did not get away. The reshading regions, of which RRM's rectangle is most, count once: as
    half of the gradient they were half of its noise. Arguments as for `loss`.
    """
    return SQUARES * (output - truth).square().mean()


def supervision(pictures: list[Tensor], truth: Tensor) -> Tensor:
    """Mean squared error of the pictures of `training.network.Heads` against the truth at their sizes, on the scale of `squared`."""
    errors = [(p - nn.functional.avg_pool2d(truth, truth.shape[-1] // p.shape[-1])).square().mean() for p in pictures]
    return SQUARES * torch.stack(errors).mean()


def _weighted(error: Tensor, mask: Tensor) -> Tensor:
    """``mean e + sum e (1 - M) / max(sum (1 - M), 1e-6)``, of which spec 6 gives M."""
    trusted = (nn.functional.interpolate(mask, scale_factor=2, mode="bilinear", align_corners=False) > 0).to(error.dtype)
    masked = (1 - trusted).expand_as(error)
    return error.mean() + (error * masked).sum() / masked.sum().clamp(min=1e-6)


def structure(output: Tensor, truth: Tensor) -> Tensor:
    """``10 (1 - SSIM)`` of the luma, mean over three scales; 0 for equal pictures. Arguments as for `loss`."""
    luma = torch.tensor(LUMA, dtype=output.dtype, device=output.device).view(1, 3, 1, 1)
    a, b = (output * luma).sum(1, keepdim=True), (truth * luma).sum(1, keepdim=True)
    total = torch.zeros((), dtype=output.dtype, device=output.device)
    for scale in range(SCALES):
        if scale:
            a, b = nn.functional.avg_pool2d(a, 2), nn.functional.avg_pool2d(b, 2)
        total = total + (1 - _similarity(a, b).mean())
    return STRUCTURE * total / SCALES


def _similarity(a: Tensor, b: Tensor) -> Tensor:
    window = min(WINDOW, *a.shape[-2:])
    maps = torch.cat([a, b, a * a, b * b, a * b], 1)
    mean_a, mean_b, aa, bb, ab = nn.functional.avg_pool2d(maps, window, STRIDE).split(1, 1)
    variances = (aa - mean_a * mean_a) + (bb - mean_b * mean_b)
    covariance = ab - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    means = (2 * mean_a * mean_b + c1) / (mean_a * mean_a + mean_b * mean_b + c1)
    return means * (2 * covariance + c2) / (variances + c2)
