# SPDX-License-Identifier: MIT
"""The numbers of the table of bounds that follow from others."""

from fractions import Fraction

import numpy as np
import pytest

from conformance.answers.port_arithmetic import Arithmetic
from conformance.tolerance import BOUNDS
from tests.meta.right_ports import cook_toom


def amplification(outputs, points):
    """How much more noise Winograd's products bring than direct ones, in rms, for white images and weights: spec docs/conformance.md.

    A product of transformed numbers is rounded relative to itself, and the output transform adds those errors up.
    """
    a, g, b = cook_toom(outputs, tuple(map(Fraction, points)))
    products = np.outer((g * g).sum(axis=1), (g * g).sum(axis=1)) * np.outer((b * b).sum(axis=1), (b * b).sum(axis=1))
    noise = (a * a) @ products @ (a * a).T
    return float(np.sqrt(noise.mean() / 9))


@pytest.mark.parametrize(("outputs", "points", "expected"), [(2, (0, 1, -1), 2), (4, (0, 1, -1, 2, -2), 12)])
def test_the_row_for_winograd(outputs, points, expected):
    """Covers F(4x4) on the points that most ports take; F(2x2) and better points lose less."""
    assert amplification(outputs, points) <= expected <= BOUNDS["layer.winograd"].roundings


def test_our_own_points_lose_less():
    ours = (0, Fraction(5, 8), Fraction(-5, 8), Fraction(3, 2), Fraction(-3, 2))
    assert amplification(4, ours) < amplification(4, (0, 1, -1, 2, -2)) / 2


def test_bfloat16_is_rounded_to_the_nearest_ties_to_even():
    given = np.array([1 + 2.0**-8, 1 + 3 * 2.0**-8, 1 + 2.0**-7, 3.4e38, -np.inf, np.nan], np.float32)
    largest = (2 - 2.0**-7) * 2.0**127
    want = [1, 1 + 2.0**-6, 1 + 2.0**-7, largest, -np.inf, np.nan]
    np.testing.assert_array_equal(Arithmetic("bfloat16").rounded(given), np.array(want, np.float32))
