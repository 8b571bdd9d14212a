# SPDX-License-Identifier: MIT
"""PSNR and SSIM as the authors compute them (spec section 9; their `utils/matlab_metric.py`, commit 0eca738).

Both are taken of 8-bit images. Luma is MATLAB's `rgb2ycbcr`: Y' of BT.601 in studio range, 16 to 235, not rounded.
Differences are nevertheless measured against 255, so a PSNR over luma is 1.3 dB above one over full-range luma.
`docs/metrics.md` has the definitions, and the places where the authors' code departs from its names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

from stss.quality.flip_vmaf import flip_map
from stss_ref.arrays import Image, Mask, Plane, require_shape

REGIONS = ("all", "edges", "holes")
"""The regions over which scores are taken: all pixels, the Canny edges of the truth, the warping holes."""

PEAK = 255.0
LUMA = (65.481, 128.553, 24.966)
LUMA_OFFSET = 16.0
WINDOW, SIGMA = 11, 1.5
MARGIN = WINDOW // 2
"""SSIM has no value closer to the frame's edge than this."""
C1, C2 = (0.01 * PEAK) ** 2, (0.03 * PEAK) ** 2
CANNY = (100, 200)

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Scores:
    """The scores of one image over one region, or means of them.

    Attributes:
        psnr_luma: dB, infinite where the two agree; None where the region is empty.
        ssim: of the luma, at most 1; None where the region is empty, or lies within 5 pixels of the frame's edge.
        psnr_rgb: dB, over R, G and B together; as ``psnr_luma``.
        flip: mean of FLIP's error map, 0 to 1, 0 where the two agree; None where the region is empty or FLIP was not taken.
        vmaf: 0 to 100, of a whole frame within its sequence; None in other regions or where VMAF was not taken.
        tpsnr: dB, of the whole frame's change since the previous frame (`stss.quality.changes`); None in other regions or without one.
        flicker: 8-bit levels, of the whole frame (likewise); None also where no surface could be followed.
    """

    psnr_luma: float | None
    ssim: float | None
    psnr_rgb: float | None
    flip: float | None = None
    vmaf: float | None = None
    tpsnr: float | None = None
    flicker: float | None = None


def to_8bit(image: Image) -> Bytes:
    """Clip to [0, 1], multiply by 255 and cut the fraction off: the authors do not round either.

    Computed in float32, in which the 256 levels of an 8-bit file come back unchanged.

    Args:
        image: (H, W, C) display-referred; not NaN.

    Returns:
        (H, W, C) uint8.
    """
    return (np.clip(image, 0, 1).astype(np.float32) * np.float32(PEAK)).astype(np.uint8)


def luma(image: Bytes) -> Plane:
    """MATLAB's luma: ``Y = (65.481 R + 128.553 G + 24.966 B) / 255 + 16``.

    Args:
        image: (H, W, 3) uint8.

    Returns:
        (H, W) float64, in 16..235, not rounded.
    """
    return image @ (np.array(LUMA) / PEAK) + LUMA_OFFSET


def psnr(image: Image | Bytes, truth: Image | Bytes, region: Mask | None = None) -> float | None:
    """PSNR: ``10 log10(255^2 / mean (image - truth)^2)``, the mean over the region's pixels and all channels.

    Args:
        image: (H, W) or (H, W, C), in 0..255.
        truth: as ``image``.
        region: (H, W) True where pixels count; None: everywhere.

    Returns:
        dB; infinite where the two agree, None where the region is empty.

    Raises:
        ArrayError: the shapes differ.
    """
    a, b = image.astype(np.float64), truth.astype(np.float64)
    require_shape("truth", b, a.shape)
    error = (a - b) ** 2
    if region is not None:
        require_shape("region", region, image.shape[:2])
        error = error[region]
    if not error.size:
        return None
    mean = float(error.mean())
    return float(10 * np.log10(PEAK**2 / mean)) if mean else float("inf")


def ssim_map(image: Plane, truth: Plane) -> Plane:
    """Map the structural similarity at each pixel around which the whole window lies in the frame.

    ``(2 m_a m_b + C1) (2 s_ab + C2) / ((m_a^2 + m_b^2 + C1) (s_aa + s_bb + C2))``, with means ``m`` and covariances
    ``s`` weighted by an 11 x 11 Gaussian of sigma 1.5, ``C1 = (0.01 * 255)^2``, ``C2 = (0.03 * 255)^2``.

    Source: Wang et al., Image Quality Assessment: From Error Visibility to Structural Similarity, 2004.

    Args:
        image: (H, W) luma, in 0..255.
        truth: as ``image``.

    Returns:
        (H - 10, W - 10) float64, of the pixels ``[5:-5, 5:-5]``; empty where the frame is smaller than the window.

    Raises:
        ArrayError: the shapes differ.
    """
    require_shape("truth", truth, image.shape)
    if min(image.shape) < WINDOW:
        return np.empty((max(image.shape[0] - 2 * MARGIN, 0), max(image.shape[1] - 2 * MARGIN, 0)))

    a, b = image.astype(np.float64), truth.astype(np.float64)
    m_a, m_b = _mean(a), _mean(b)
    s_aa, s_bb, s_ab = _mean(a * a) - m_a * m_a, _mean(b * b) - m_b * m_b, _mean(a * b) - m_a * m_b
    return (2 * m_a * m_b + C1) * (2 * s_ab + C2) / ((m_a * m_a + m_b * m_b + C1) * (s_aa + s_bb + C2))


def edges(truth: Bytes) -> Mask:
    """True on the Canny edges (thresholds 100, 200) of an image's full-range grey, (H, W, 3) uint8 to (H, W)."""
    grey = cv2.cvtColor(truth, cv2.COLOR_RGB2GRAY)
    return cv2.Canny(grey, *CANNY) != 0


def upsample_holes(hole: Mask) -> Mask:
    """Holes at output size: where the valid mask, upsampled bilinearly by 2, is 0 (spec section 6's M).

    Args:
        hole: (H, W) True in a warping hole.

    Returns:
        (2H, 2W) True where every pixel that the upsampling reads is a hole.
    """
    height, width = hole.shape
    valid = np.where(hole, np.float32(0), np.float32(1))
    # INTER_LINEAR has pixel centres at (o + 0.5) / 2 - 0.5: the grid of spec section 7 without aligned corners.
    return cv2.resize(valid, (2 * width, 2 * height), interpolation=cv2.INTER_LINEAR) == 0


def score(image: Image, truth: Image, hole: Mask | None = None, *, flip: bool = False) -> Mapping[str, Scores]:
    """Compute all scores of one frame.

    Args:
        image: (H, W, 3) display-referred.
        truth: as ``image``.
        hole: (H, W) True in a warping hole, at the images' size; None: there are none.
        flip: take FLIP too, of the images before they are cut to 8 bits.

    Returns:
        Region, in the order of ``REGIONS``, -> scores.

    Raises:
        ArrayError: the shapes differ, or are not (H, W, 3).
    """
    require_shape("image", image, (None, None, 3))
    require_shape("truth", truth, image.shape)
    a, b = to_8bit(image), to_8bit(truth)
    y_a, y_b = luma(a), luma(b)
    similarity = ssim_map(y_a, y_b)
    nowhere = np.zeros(y_a.shape, dtype=np.bool_)
    regions = {"all": None, "edges": edges(b), "holes": nowhere if hole is None else hole}
    different = flip_map(image, truth) if flip else None
    return {
        name: Scores(
            psnr(y_a, y_b, region),
            _over(similarity, region),
            psnr(a, b, region),
            None if different is None else mean_over(different, region),
        )
        for name, region in regions.items()
    }


def mean_scores(frames: Sequence[Mapping[str, Scores]], *, complete: bool = False) -> Mapping[str, Scores]:
    """Mean over frames of each score; a PSNR's mean is over decibels.

    Args:
        frames: results of ``score``, one per frame, or means of them.
        complete: True: None unless every frame has a value; False: frames without one do not count.

    Returns:
        As ``score``.
    """
    result: dict[str, Scores] = {}
    for region in REGIONS:
        values: list[float | None] = []
        for field in fields(Scores):
            column: list[float | None] = [getattr(scores[region], field.name) for scores in frames]
            numbers = [value for value in column if value is not None]
            usable = bool(numbers) and not (complete and len(numbers) < len(column))
            values.append(sum(numbers) / len(numbers) if usable else None)
        result[region] = Scores(*values)
    return result


def mean_over(plane: Plane, region: Mask | None) -> float | None:
    """Mean of (H, W) over a region (H, W), or everywhere if that is None. Returns None where the region is empty."""
    values = plane if region is None else plane[region]
    return float(values.mean(dtype=np.float64)) if values.size else None


def _mean(plane: Plane) -> Plane:
    """Gaussian mean around each pixel where the window fits."""
    weights = cv2.getGaussianKernel(WINDOW, SIGMA)
    return np.asarray(cv2.sepFilter2D(plane, -1, weights, weights)[MARGIN:-MARGIN, MARGIN:-MARGIN], np.float64)


def _over(similarity: Plane, region: Mask | None) -> float | None:
    return mean_over(similarity, None if region is None else region[MARGIN:-MARGIN, MARGIN:-MARGIN])
