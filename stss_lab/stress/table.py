# SPDX-License-Identifier: MIT
"""The plan, the tables and the measure of errors of `stss stress`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from conformance.protocol.port import Arrays
from conformance.tolerance import UNIT
from stss_lab.stress.engines import Engine
from stss_ref.arrays import Array
from stss_ref.weights import Weights
from stss_ref.weights import random as random_weights

Cell = str | float
"""A cell of a table: text or a number."""


@dataclass(frozen=True)
class StressTable:
    """One table of the report.

    Attributes:
        key: its name in the JSON and for ``--only``.
        title: its contents, with the unit of its numbers.
        columns: the headings.
        rows: a cell for each column.
    """

    key: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def short(number: float) -> str:
    """Two or three significant digits, without an exponent where that is not longer."""
    if not math.isfinite(number):
        return "inf" if number > 0 else "-"
    if number == 0 or 1e-3 <= abs(number) < 1e4:
        return np.format_float_positional(number, precision=3 if abs(number) >= 100 else 2, fractional=False, trim="-")
    mantissa, exponent = f"{number:.1e}".split("e")
    return f"{mantissa.removesuffix('.0')}e{int(exponent)}"


@dataclass(frozen=True)
class StressPlan:
    """The measurements, and their number.

    Attributes:
        engines: compared with the truth; the first is the reference in float32.
        seeds: how many draws of inputs, and of weights unless they are given; a number in a table is the worst of them.
        size: (H, W) of the frames where the size does not vary; multiples of 8.
        sizes: sides of the square frames of the sweep over sizes.
        weights: the 92 tensors; None: random ones, different for each seed.
    """

    engines: Sequence[Engine] = field(repr=False)
    seeds: int = 3
    size: tuple[int, int] = (48, 64)
    sizes: tuple[int, ...] = (8, 16, 32, 64, 128)
    weights: Weights | None = field(default=None, repr=False)

    def weights_of(self, seed: int) -> Weights:
        """The network's tensors for one seed, float32."""
        return random_weights(seed) if self.weights is None else self.weights


def relative_error(got: Arrays, truth: Arrays) -> float:
    """``max |got - truth| / max |truth|``, the largest over the outputs; infinite where an output is not finite."""
    ratios = [_ratio(got[name].astype(np.float64), truth[name]) for name in truth]
    return max(ratio if np.isfinite(ratio) else float("inf") for ratio in ratios)


def _ratio(got: Array, truth: Array) -> float:
    largest, error = float(np.abs(truth).max()), float(np.abs(got - truth).max())
    return 0.0 if error == 0 else error / largest if largest else float("inf")


def in_units(error: float, arithmetic: Engine) -> float:
    """A relative error in units of the arithmetic's rounding: 2^-24 of float32, 2^-11 of half, 2^-8 of bfloat16."""
    return error / UNIT[arithmetic.dtype]
