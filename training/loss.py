# SPDX-License-Identifier: MIT
"""The training loss of spec section 6, and the perceptual term of our choice.

The perceptual term is structural similarity (Wang 2004) of the luma, over windows of 7 x 7 at three scales. It needs no
trained network, so nothing is downloaded and no licence is inherited. Like the eye, it compares structure relative to the
local contrast, where L1 accepts a blur. A mix of the two is known to beat each alone, even by the other's measure (Zhao et
al. 2017, Loss Functions for Image Restoration with Neural Networks).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

PERCEPTUAL = 0.01
"""Weight of the perceptual term (spec 6)."""
STRUCTURE = 25.0
"""The perceptual distance is this many times 1 - SSIM: on aliased frames, with SSIM about 0.8, 0.01 of it (spec 6) is as much as L1."""
SCALES = 3
WINDOW, STRIDE = 7, 3
"""Windows overlap, but only every third one along each axis counts: all of them would take a sixth of a step's time on a CPU."""
LUMA = (0.299, 0.587, 0.114)


def loss(output: Tensor, truth: Tensor, mask: Tensor, perceptual: Tensor | float) -> Tensor:
    """L1 over the pictures, once more over the reshading regions, and the perceptual term.

    ``mean |o - y| + sum |o - y| (1 - M) / max(sum (1 - M), 1e-6) + 0.01 perceptual``

    The sums run over the batch as over one large picture: if each sample were divided by its own holes, a hole of one pixel
    would weigh as much as a frame.

    Source: spec 6.

    Args:
        output, truth: (N, 3, 2H, 2W) display-referred.
        mask: (N, 1, H, W) 1 = to be trusted, RRM's rectangle included.
        perceptual: the perceptual distance, see `structure`.
    """
    return _weighted((output - truth).abs(), mask) + PERCEPTUAL * perceptual


SQUARES = 20.0
"""Factor of the squared error: errors of about 0.002 squared then weigh as much as an L1 of 0.03."""


def squared(output: Tensor, truth: Tensor) -> Tensor:
    """The mean squared error, for the start of a run, and for a high PSNR.

    The gradient of L1 does not shrink with the error: a residual that is right at edges and noise elsewhere shrinks to 0
    everywhere, and the network did not get away from 0. The reshading regions, mostly RRM's rectangle, count only once: as
    half of the gradient they were half of its noise. Arguments as for `loss`.
    """
    return SQUARES * (output - truth).square().mean()


def supervision(pictures: list[Tensor], truth: Tensor) -> Tensor:
    """Mean squared error of the pictures of `training.network.Heads` against the truth at their sizes, on the scale of `squared`."""
    errors = [(p - nn.functional.avg_pool2d(truth, truth.shape[-1] // p.shape[-1])).square().mean() for p in pictures]
    return SQUARES * torch.stack(errors).mean()


def _weighted(error: Tensor, mask: Tensor) -> Tensor:
    """``mean e + sum e (1 - M) / max(sum (1 - M), 1e-6)``, with the mask M (spec 6)."""
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
