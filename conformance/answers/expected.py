# SPDX-License-Identifier: MIT
"""The right answers of an output: the truth, the allowed error, and other answers that are equally right."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.tolerance import worst

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Expected:
    """The right answers of one output.

    Attributes:
        want: the truth.
        allowed: the allowed error of each number; shape of ``want``, or one number.
        others: further right answers, each of the shape of ``want``: where rounding decides, either side is right.
        vectors: whether the last axis belongs together: an answer is right as a whole, and non-finite as a whole.
        rms: the largest root mean square of all errors together; infinite: no limit.
        free: where rounding decides between whole ranges of answers, which ``allowed`` spans; broadcasts to ``want``. An error within it
            counts as none, since it says nothing of the port's arithmetic.
    """

    want: NDArray[Any]
    allowed: NDArray[Any] | float
    others: tuple[NDArray[Any], ...] = ()
    vectors: bool = False
    rms: float = np.inf
    free: Bool | None = None

    @property
    def undecided(self) -> int:
        """Number of values that have more than one right answer."""
        different = np.zeros(self.want.shape, bool)
        for other in self.others:
            different |= (other != self.want) & ~(np.isnan(other) & np.isnan(self.want))
        if self.free is not None:
            different |= self.free
        return int(different.sum())

    def ratios(self, got: NDArray[Any]) -> Float64:
        """``error / allowed`` of each number, against the right answer nearest to it; a wrong mask is infinitely wrong."""
        ratios = reduce(np.minimum, (self._against(got, want) for want in (self.want, *self.others)))
        return ratios if self.free is None else np.where(self.free & (ratios <= 1), 0.0, ratios)

    def together(self, got: NDArray[Any]) -> float:
        """Root mean square of all errors, divided by its limit."""
        if np.isinf(self.rms) or got.shape != self.want.shape:
            return 0.0
        with np.errstate(over="ignore", invalid="ignore"):
            return worst(np.sqrt(np.mean((got.astype(np.float64) - self.want) ** 2)), np.asarray(self.rms))

    def part(self, place: tuple[slice, ...]) -> Expected:
        """The right answers of a part of the output."""
        allowed, free = (
            np.broadcast_to(array, self.want.shape)[place] if isinstance(array, np.ndarray) else array
            for array in (self.allowed, self.free)
        )
        others = tuple(other[place] for other in self.others)
        return replace(self, want=self.want[place], allowed=allowed, others=others, free=free)

    def closer(self, got: NDArray[Any]) -> Expected:
        """The same, with the limit of the root mean square for each number, if ``got`` only exceeds that limit."""
        return replace(self, allowed=self.rms) if largest(self, got) <= 1 < self.together(got) else self

    def _against(self, got: NDArray[Any], want: NDArray[Any]) -> Float64:
        allowed = np.broadcast_to(np.asarray(self.allowed, np.float64), want.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.abs(got.astype(np.float64) - want)
            ratio = np.where(error == 0, 0.0, error / allowed)
        ratio = np.where(np.isnan(ratio), np.inf, ratio)
        if not self.vectors:
            return ratio
        ratio = np.broadcast_to(ratio.max(axis=-1, keepdims=True), ratio.shape)
        non_finite = [~np.isfinite(a).all(axis=-1, keepdims=True) for a in (got, want)]
        return np.where(non_finite[0] & non_finite[1], 0.0, ratio)


def mask(want: Bool, unsure: Bool) -> Expected:
    """A mask whose ``unsure`` elements may be either."""
    others = (np.where(unsure, ~want, want).astype(np.uint8),) if unsure.any() else ()
    return Expected(want.astype(np.uint8), 0.0, others)


def largest(expected: Expected, got: NDArray[Any]) -> float:
    """Largest ``error / allowed``; infinite where shapes differ."""
    if got.shape != expected.want.shape:
        return np.inf
    return float(expected.ratios(got).max(initial=0.0))
