# SPDX-License-Identifier: MIT
"""Many sums together: whether they are rounded either way as often, or always to one side."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.port_arithmetic import Arithmetic
from conformance.tolerance import BOUNDS, UNIT

FEWEST = 1000
"""Sums that say something together."""


def rounding(got: NDArray[Any], want: NDArray[Any], terms: int, arithmetic: Arithmetic) -> NDArray[np.float64]:
    """Mean square and signed sum of the errors, in units of the expected rounding.

    A partial sum is at most ``S``, the sum of what is added, all of one sign. Adding to it rounds by up to ``u S``, either way as
    often: variance ``(u S)^2 / 3`` at most, ``n`` times. Where results are stored in half, ``layer.float16`` roundings of that are added.

    Args:
        got: a port's sums.
        want: the true ones, none of them 0.
        terms: ``n``, products in one.
        arithmetic: of the port.

    Returns:
        ``mean(e^2)`` and ``sum(e) / sqrt(N)``, ``e`` the errors over the root of that variance.
    """
    assert want.size >= FEWEST
    variance = (terms + BOUNDS["layer"].roundings) * UNIT["float32"] ** 2
    if arithmetic.winograd:
        variance *= BOUNDS["layer.winograd"].roundings ** 2
    if arithmetic.dtype == "float16":
        variance += BOUNDS["layer.float16"].roundings * arithmetic.unit**2
    error = (got.astype(np.float64) - want) / (np.abs(want) * np.sqrt(variance / 3))
    return np.array([np.mean(error * error), np.sum(error) / np.sqrt(error.size)])


def expected_rounding(arithmetic: Arithmetic) -> Expected:
    """Their limits. Winograd's transformed weights round once for all pixels, so that its errors are alike: they have no sign to sum."""
    signed = np.inf if arithmetic.winograd else BOUNDS["sums.signed"].roundings
    return Expected(np.zeros(2), np.array([BOUNDS["sums.square"].roundings, signed]))
