# SPDX-License-Identifier: MIT
"""Many sums together: whether their rounding errors have both signs equally often, or mostly one sign."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.port_arithmetic import Arithmetic
from conformance.tolerance import BOUNDS, UNIT

FEWEST = 1000
"""Fewest sums from which a bias shows."""


def rounding(
    got: NDArray[Any], want: NDArray[Any], terms: int, arithmetic: Arithmetic, behind: float = 0.0
) -> NDArray[np.float64]:
    """Mean square and signed sum of the errors, in units of the expected rounding.

    A partial sum is at most ``S``, the whole sum, since all terms have one sign. Each of ``n`` additions rounds by up to ``u S``, either
    way equally often, which gives a variance of at most ``(u S)^2 / 3``. If results are stored in half, ``layer.float16`` such roundings
    to half are added.

    Args:
        got: a port's sums.
        want: the true sums, none of them 0.
        terms: ``n``, number of products in a sum.
        arithmetic: of the port.
        behind: roundings to float32 behind the sum, which may be alike for all sums, and do not count.

    Returns:
        ``mean(e^2)`` and ``sum(e) / sqrt(N)``, ``e`` the errors over the root of that variance.
    """
    assert want.size >= FEWEST
    variance = (terms + BOUNDS["layer"].roundings) * UNIT["float32"] ** 2
    if arithmetic.winograd:
        variance *= BOUNDS["layer.winograd"].roundings ** 2
    if arithmetic.dtype != "float32":
        variance += BOUNDS["layer.float16"].roundings * arithmetic.unit**2
    error = got.astype(np.float64) / np.abs(want) - np.sign(want)
    error = np.sign(error) * np.maximum(np.abs(error) - behind * UNIT["float32"], 0) / np.sqrt(variance / 3)
    return np.array([np.mean(error * error), np.sum(error) / np.sqrt(error.size)])


def expect_rounding(arithmetic: Arithmetic) -> Expected:
    """Limits of `rounding`. Winograd's weights round once for all pixels, so its errors are alike, and their signed sum has no limit."""
    signed = np.inf if arithmetic.winograd else BOUNDS["sums.signed"].roundings
    return Expected(np.zeros(2), np.array([BOUNDS["sums.square"].roundings, signed]))
