# SPDX-License-Identifier: MIT
"""The rounding of one operator: its right numbers, and the largest error of a port's if its inputs are the same.

A sum of ``n`` products loses at most ``gamma_n = n u / (1 - n u)`` of the same sum of magnitudes, whatever the order of its terms and
whether products and sums are fused (Higham, Accuracy and Stability, section 3.1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.port_arithmetic import Arithmetic

AnyArray = NDArray[Any]


@dataclass(frozen=True)
class Result:
    """A tensor.

    Attributes:
        x: float64, or integers.
        e: the largest allowed error of a port's number; 0.0: it is exact.
        terms: of the sum whose rounding ``e`` is: rounding is a random walk, so the usual error is ``sqrt(terms)`` below the most.
    """

    x: AnyArray
    e: AnyArray | float = 0.0
    terms: AnyArray | float = 1

    @property
    def errors(self) -> AnyArray:
        """``e`` in the shape of ``x``."""
        return np.broadcast_to(np.asarray(self.e, np.float64), self.x.shape)


@dataclass(frozen=True)
class Rounding:
    """The rounding of a port's arithmetic."""

    arithmetic: Arithmetic

    @property
    def unit(self) -> float:
        """Unit roundoff of stored numbers and of functions."""
        return self.arithmetic.unit

    def gamma(self, roundings: float) -> float:
        """The largest relative change by this number of roundings."""
        n = roundings * self.unit
        return n / (1 - n) if n < 0.5 else 2 * n

    def lose(self, x: AnyArray, roundings: float, scale: AnyArray | float | None = None) -> Result:
        """``x`` with the error of ``roundings`` of numbers of size ``scale`` (None: of its own)."""
        return Result(x, self.gamma(roundings) * (np.abs(x) if scale is None else scale) + self.arithmetic.tiny)

    def products(self, apply: Callable[[AnyArray, AnyArray], AnyArray], a: AnyArray, b: AnyArray, terms: int) -> Result:
        """A sum of ``terms`` products of ``a`` and ``b``."""
        result = self.lose(apply(a, b), terms, apply(np.abs(a), np.abs(b)))
        return Result(result.x, result.e, terms)

    def sums(self, apply: Callable[[AnyArray], AnyArray], a: AnyArray, terms: float) -> Result:
        """A sum of ``terms`` numbers with weights of at least 0."""
        result = self.lose(apply(a), terms, apply(np.abs(a)))
        return Result(result.x, result.e, terms)
