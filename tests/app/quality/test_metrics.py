# SPDX-License-Identifier: MIT
"""PSNR and SSIM (spec section 9)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stss.quality import metrics
from stss_ref.arrays import ArrayError

quick = settings(deadline=None, max_examples=30)

# What float64 loses of an SSIM. A variance is a mean of squares minus the square of a mean, both below 235^2 < 2**16:
# fewer than 64 roundings (11 taps, twice, each a product and a sum) of at most 2**(16 - 53). Four such terms stand in
# the second factor, whose divisor is at least C2 > 58; the first factor's own rounding is far below that.
SSIM_LOST = 4 * 64 * 2.0 ** (16 - 53) / 58


@st.composite
def image_pairs(draw):
    """Two 8-bit images of one size, some of them the same, some smaller than SSIM's window."""
    size = draw(st.tuples(st.integers(1, 24), st.integers(1, 24)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    truth = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    noise = rng.integers(-draw(st.integers(0, 255)), 256, truth.shape) * draw(st.sampled_from([0, 1]))
    return np.clip(truth + noise, 0, 255).astype(np.uint8), truth


def slow_ssim(a, b):
    """The formula, one window at a time, with plain Python sums."""
    weight = np.array([math.exp(-((i - 5) ** 2) / (2 * 1.5**2)) for i in range(11)])
    weight = np.outer(weight, weight) / weight.sum() ** 2
    result = np.empty((a.shape[0] - 10, a.shape[1] - 10))
    for y, x in np.ndindex(result.shape):
        p, q = a[y : y + 11, x : x + 11], b[y : y + 11, x : x + 11]
        mp, mq = (weight * p).sum(), (weight * q).sum()
        spp, sqq = (weight * (p - mp) ** 2).sum(), (weight * (q - mq) ** 2).sum()
        spq = (weight * (p - mp) * (q - mq)).sum()
        top = (2 * mp * mq + 6.5025) * (2 * spq + 58.5225)
        result[y, x] = top / ((mp**2 + mq**2 + 6.5025) * (spp + sqq + 58.5225))
    return result


def test_8_bit_cuts_off_the_fraction():
    """As the authors: 0.999 is 254, and what lies outside [0, 1] is clipped."""
    image = np.float32([[[0, 0.999, 1], [-0.5, 1.5, 0.5]]])
    assert metrics.to_8bit(image).tolist() == [[[0, 254, 255], [0, 255, 127]]]
    levels = np.arange(256, dtype=np.uint8)
    assert metrics.to_8bit(np.float32(levels) / np.float32(255)).tolist() == levels.tolist()  # none is lost to rounding


def test_luma_of_known_colours():
    """MATLAB: black 16, white 235, red, green and blue 65.481, 128.553, 24.966 above black."""
    colors = np.uint8([[[0, 0, 0], [255, 255, 255], [255, 0, 0], [0, 255, 0], [0, 0, 255]]])
    expected = [[16, 235, 81.481, 144.553, 40.966]]
    # A sum of four numbers below 256 in float64: 4 roundings of at most 2**-46 each.
    assert np.abs(metrics.luma(colors) - expected).max() <= 4 * 2.0**-46


@pytest.mark.parametrize(("difference", "expected"), [(1, 48.130803609), (16, 24.048403956)])
def test_psnr_worked_by_hand(difference, expected):
    """A difference of 1 everywhere: 20 log10 255 = 48.13 dB."""
    truth = np.full((3, 5, 3), 100, np.uint8)
    assert abs(metrics.psnr(truth + np.uint8(difference), truth) - expected) < 1e-9  # the digits given


def test_an_empty_region_has_no_score():
    """Neither 0 nor infinity nor NaN: there is nothing to judge."""
    image, nowhere = np.zeros((20, 20, 3)), np.zeros((20, 20), np.bool_)
    rim = ~nowhere
    rim[5:-5, 5:-5] = False
    for hole, same in ((nowhere, None), (rim, math.inf)):
        scores = metrics.score(image, image, hole)["holes"]
        assert (scores.psnr_luma, scores.ssim, scores.psnr_rgb) == (same, None, same)


@quick
@given(pair=image_pairs())
def test_ssim_agrees_with_the_formula_taken_literally(pair):
    """Against an independent implementation, window by window."""
    a, b = metrics.luma(pair[0]), metrics.luma(pair[1])
    if min(a.shape) < 11:
        assert metrics.score(pair[0] / 255, pair[1] / 255)["all"].ssim is None
        return
    assert np.abs(metrics.ssim_map(a, b) - slow_ssim(a, b)).max() <= SSIM_LOST


def test_edges_are_those_of_the_truth():
    """A black and a white half: the edge runs along the border between them, nowhere else."""
    truth = np.zeros((16, 16, 3), np.uint8)
    truth[:, 8:] = 255
    mask = metrics.edges(truth)
    assert mask.any(axis=1).all()
    assert not mask[:, :6].any()
    assert not mask[:, 10:].any()
    assert not metrics.edges(np.full_like(truth, 128)).any()


def test_holes_at_output_size_worked_by_hand():
    """Upsampled, a hole loses the rim that reads a neighbour that can be trusted; at the frame's edge it keeps it."""
    hole = np.array([[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 0, 1]], np.bool_)
    expected = np.zeros((6, 8), np.bool_)
    expected[:3, :3] = True
    expected[5, 7] = True
    assert metrics.upsample_holes(hole).tolist() == expected.tolist()


def test_score_says_what_does_not_fit():
    """Sizes that differ are never stretched."""
    with pytest.raises(ArrayError, match=r"truth: expected shape \(4, 4, 3\), got \(4, 5, 3\)"):
        metrics.score(np.zeros((4, 4, 3), np.float32), np.zeros((4, 5, 3), np.float32))
