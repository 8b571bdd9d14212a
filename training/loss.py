# SPDX-License-Identifier: MIT
"""The training loss of spec section 6, and the perceptual term of our choice.

The perceptual term is structural similarity (Wang 2004) of the luma, as `stss compare` takes it. It needs no trained
network, so there is no download and no foreign licence; like the eye, it compares structure relative to the local contrast,
while L1 accepts a blur; and the mix of the two is known to beat either alone, also by the measures of
the other (Zhao et al. 2017, Loss Functions for Image Restoration with Neural Networks).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from stss.quality.metrics import C1, C2, LUMA, LUMA_OFFSET, PEAK, SIGMA, WINDOW

PERCEPTUAL = 0.01
"""Weight of the perceptual term (spec 6)."""
STRUCTURE = 25.0
"""The perceptual distance over 1 - SSIM: with the 0.01 of spec 6, as much as L1 on aliased frames, SSIM about 0.8."""


def trusted(mask: Tensor) -> Tensor:
    """1 where the mask (N, 1, H, W), enlarged to (N, 1, 2H, 2W), is above 0, and 0 in reshading regions."""
    return (nn.functional.interpolate(mask, scale_factor=2, mode="bilinear", align_corners=False) > 0).to(mask.dtype)


def loss(output: Tensor, truth: Tensor, trust: Tensor, perceptual: Tensor | float) -> Tensor:
    """L1 over the pictures, once more over the reshading regions, and the perceptual term.

    ``mean |o - y| + sum |o - y| (1 - M) / max(sum (1 - M), 1e-6) + 0.01 perceptual``

    The sums run over the batch as over one large picture: if each sample were divided by its own holes, a hole of one pixel
    would weigh as much as a frame.

    Source: spec 6.

    Args:
        output, truth: (N, 3, 2H, 2W) display-referred.
        trust: (N, 1, 2H, 2W), see `trusted`; RRM's rectangle is none of it.
        perceptual: the perceptual distance, `STRUCTURE` times the mean of `structure`.
    """
    return _weigh_by_trust((output - truth).abs(), trust) + PERCEPTUAL * perceptual


SQUARES = 20.0
"""Factor of the squared error: errors of about 0.002 squared then weigh as much as an L1 of 0.03."""


def squared(output: Tensor, truth: Tensor, extrapolated: float = 0.5, trust: Tensor | None = None, holes: float = 1.0) -> Tensor:
    """The mean squared error, for the start of a run, and for a high PSNR.

    The gradient of L1 does not shrink with the error: a residual that is right at edges and noise elsewhere shrinks to 0
    everywhere, and the network did not get away from 0. The reshading regions, mostly RRM's rectangle, count only once: as
    half of the gradient they were half of its noise. Arguments as for `loss`; every second sample, from the second on, is an
    EF, and ``extrapolated`` is the share of EFs in the sum: 0.5 weighs all samples alike. Where ``trust`` is 0, errors count ``holes``
    times: EFs lose a third of theirs there.
    """
    squares = (output - truth).square()
    if trust is not None and holes != 1:
        squares = squares * (holes + (1 - holes) * trust)
    return SQUARES * by_kind(squares.mean((1, 2, 3)), 2 * (1 - extrapolated), 2 * extrapolated)


def unsteadiness(error: Tensor, motion: Tensor) -> Tensor:
    """How the errors of consecutive frames differ along the motion: flicker's error as `stss compare` takes it, of values to 1.

    Args:
        error: output less truth (N, 3, 2H, 2W); samples 0 and 1, 2 and 3 and so on are partners.
        motion: (N, 2, H, W) low-resolution pixels, a sample to its partner. Motion that leads outside the crop does not count.
    """
    warped, followed = led_along(error.unflatten(0, (-1, 2)).flip(1).flatten(0, 1), motion)
    return ((error - warped).abs().mean(1) * followed).sum() / followed.sum().clamp(min=1)


def led_along(planes: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
    """The planes (N, C, 2H, 2W) where ``motion`` (N, 2, H, W) leads, and 1 where that lies within them, else 0, (N, 2H, 2W)."""
    height, width = planes.shape[-2:]
    x, y = (2 * nn.functional.interpolate(motion, scale_factor=2.0)).unbind(1)
    x = x + torch.arange(width, dtype=x.dtype, device=x.device)
    y = y + torch.arange(height, dtype=y.dtype, device=y.device)[:, None]
    followed = ((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)).to(planes.dtype)
    grid = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], -1)
    return nn.functional.grid_sample(planes, grid, padding_mode="border", align_corners=False), followed


def supervision(pictures: list[Tensor], truth: Tensor) -> Tensor:
    """Mean squared error of the pictures of `training.network.Heads` against the truth at their sizes, on the scale of `squared`."""
    errors = [(p - nn.functional.avg_pool2d(truth, truth.shape[-1] // p.shape[-1])).square().mean() for p in pictures]
    return SQUARES * torch.stack(errors).mean()


def _weigh_by_trust(error: Tensor, trust: Tensor) -> Tensor:
    """``mean e + sum e (1 - M) / max(sum (1 - M), 1e-6)``, with the mask M (spec 6)."""
    masked = (1 - trust).expand_as(error)
    return error.mean() + (error * masked).sum() / masked.sum().clamp(min=1e-6)


def structure(output: Tensor, truth: Tensor) -> Tensor:
    """``1 - SSIM`` of the luma of each sample, (N,), as `stss.quality.metrics.ssim_map` but for its 8 bits; 0 for equal pictures.

    Arguments as for `loss`; pictures of 11 x 11 or more.
    """
    weights = torch.tensor(LUMA, dtype=output.dtype, device=output.device).view(1, 3, 1, 1) / PEAK
    a, b = ((picture * weights).sum(1, keepdim=True) + LUMA_OFFSET / PEAK for picture in (output, truth))
    mean_a, mean_b, aa, bb, ab = _mean(torch.cat([a, b, a * a, b * b, a * b])).chunk(5)
    variances = (aa - mean_a * mean_a) + (bb - mean_b * mean_b)
    covariance = ab - mean_a * mean_b
    c1, c2 = C1 / PEAK**2, C2 / PEAK**2
    means = (2 * mean_a * mean_b + c1) / (mean_a * mean_a + mean_b * mean_b + c1)
    return 1 - (means * (2 * covariance + c2) / (variances + c2)).mean((1, 2, 3))


def by_kind(values: Tensor, rendered: float, extrapolated: float) -> Tensor:
    """The mean of the samples' ``values`` (N,), those of SFs times ``rendered``, those of EFs, every second one, times the other."""
    if rendered == extrapolated:
        return rendered * values.mean()
    return (values * values.new_tensor([rendered, extrapolated]).repeat(len(values) // 2)).mean()


def _mean(planes: Tensor) -> Tensor:
    """Over a Gaussian window, where it lies within the planes (N, 1, H, W). As products with matrices: a tenth of convolutions' time."""
    height, width = planes.shape[-2:]
    return _window(height, planes) @ planes @ _window(width, planes).T


def _window(length: int, like: Tensor) -> Tensor:
    """(length - 10, length): each row has the window one further on."""
    across = torch.arange(WINDOW, dtype=like.dtype, device=like.device) - WINDOW // 2
    rows = torch.arange(length - WINDOW + 1, device=like.device)[:, None]
    empty = torch.zeros(len(rows), length, dtype=like.dtype, device=like.device)
    bell = torch.softmax(-(across**2) / (2 * SIGMA**2), 0).expand(len(rows), -1)
    return empty.scatter(1, rows + torch.arange(WINDOW, device=like.device), bell)
