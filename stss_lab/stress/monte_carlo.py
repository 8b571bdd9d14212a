# SPDX-License-Identifier: MIT
"""Monte Carlo arithmetic on the reference, without a change to its code.

The reference is NumPy from its inputs to its image, and NumPy hands every operation on a subclass of its array to that subclass. So a
`Watched` array, passed to a stage as an input, sees every operation of the stage: it lets NumPy compute in float64 and shows the result to
its watcher. `StochasticRounding` rounds the result up or down at random to 24 or 11 bits; `Trace` only records it.

A matrix product counts as one operation. A result that is exact in that many bits (a comparison, a maximum, a difference of neighbours)
stays exact, as in a machine. Exponents have no limits: `stss_lab.stress.hard_image_cases` covers overflow and subnormal numbers.

Source: D. Stott Parker, Monte Carlo Arithmetic, 1997; stochastic rounding: N. Higham and T. Mary, 2019.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from conformance.protocol.port import Arrays
from conformance.protocol.stages import reference
from stss_ref.arrays import Array
from stss_ref.weights import Weights

Where = Literal["operations", "layers"]
"""What to round: every operation, or the inputs of convolutions and attention, which are the numbers that a backend stores."""


FLOATS = (np.dtype(np.float64), np.dtype(np.float32))
"""Types that are watched; indices and comparisons are not."""


class Watcher:
    """Sees the results that a stage computes, and may change them in place."""

    def result(self, array: Array) -> None:
        """Called with the result of one operation."""

    def padded(self, array: Array) -> None:
        """Called with an array that is about to be padded with zeros: a convolution's input, the attention's keys and values."""


class StochasticRounding(Watcher):
    """Rounds float64 to a number of bits, up or down at random, so that the expected result is the exact one.

    Args:
        bits: bits of the significand; 24 as in float32, 11 as in half.
        seed: seed of the random numbers.
        where: what to round.
    """

    def __init__(self, bits: int, seed: int, where: Where = "operations"):
        self._lost = 53 - bits
        self._random = np.random.default_rng(seed)
        self._where: Where = where

    def result(self, array: Array) -> None:
        """See ``Watcher``."""
        if self._where == "operations":
            self._round(array)

    def padded(self, array: Array) -> None:
        """See ``Watcher``."""
        if self._where == "layers":
            self._round(array)

    def _round(self, array: Array) -> None:
        # On the bits: adding a random number below one unit carries with the probability of the part to be lost, which is then cut off.
        bits = array.view(np.int64)
        dice = self._random.integers(0, 1 << self._lost, array.shape)
        bits += np.where(np.isfinite(array), dice, 0)
        bits &= -(1 << self._lost)


class Trace(Watcher):
    """Records what each convolution reads.

    Attributes:
        read: the arrays read, in the order of computation.
    """

    def __init__(self) -> None:
        self.read: list[Array] = []

    def padded(self, array: Array) -> None:
        """See ``Watcher``."""
        self.read.append(array.copy())


class Watched(np.ndarray[Any, np.dtype[Any]]):
    """An array that shows every result computed from it to a watcher; results that are floats are watched too."""

    watcher: Watcher | None = None

    def __array_finalize__(self, obj: Any) -> None:
        self.watcher = getattr(obj, "watcher", None)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, out: tuple[Any, ...] | None = None, **options: Any) -> Any:
        if out is not None:
            options["out"] = tuple(_plain(array) for array in out)
        given = (self, *inputs, *(out or ()))
        watcher = next((x.watcher for x in given if isinstance(x, Watched) and x.watcher is not None), None)
        result = getattr(ufunc, method)(*(_plain(array) for array in inputs), **options)
        if watcher is None or getattr(result, "dtype", None) not in FLOATS:
            return result
        array = np.asarray(result)
        watcher.result(array)
        return _watch(array, watcher)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if func is np.pad and self.watcher is not None:
            array = np.array(args[0])
            self.watcher.padded(array)
            args = (array, *args[1:])
        result = super().__array_function__(func, types, _bare(args), _bare(kwargs))
        watched = isinstance(result, np.ndarray) and result.dtype in FLOATS and self.watcher is not None
        return _watch(np.asarray(result), self.watcher) if watched else result


def _plain(x: Any) -> Any:
    return x.view(np.ndarray) if isinstance(x, Watched) else x


def _bare(x: Any) -> Any:
    """``x`` with plain arrays in place of watched ones, in lists and tuples too."""
    if isinstance(x, list | tuple):
        return type(x)(map(_bare, x))
    return {name: _bare(value) for name, value in x.items()} if isinstance(x, dict) else _plain(x)


def _watch(array: Array, watcher: Watcher | None) -> Watched:
    watched = array.view(Watched)
    watched.watcher = watcher
    return watched


def watched(inputs: Arrays, watcher: Watcher, dtype: str = "float64") -> dict[str, Any]:
    """The inputs of a stage in ``dtype`` (integers and masks unchanged), as arrays watched by ``watcher``."""
    return {n: _watch(a.astype(dtype), watcher) if a.dtype.kind == "f" else a for n, a in inputs.items()}


def samples(stage: str, inputs: Arrays, weights: Weights, make: Callable[[int], Watcher], count: int) -> dict[str, Array]:
    """Compute a stage ``count`` times, each time with other random roundings.

    Args:
        stage: one of ``conformance.protocol.stages.STAGES``.
        inputs: its inputs, of any float dtype.
        weights: the 92 tensors.
        make: makes the watcher of the i-th run.
        count: number of runs.

    Returns:
        Output -> (count, ...) float64.
    """
    runs = [reference(stage, watched(inputs, make(i)), weights) for i in range(count)]
    return {name: np.stack([run[name] for run in runs]) for name in runs[0]}


def significant_digits(runs: Array, bits: int) -> Array:
    """Decimal digits in which the runs agree: ``s = -log10(sigma / |mu|)``, clipped to 0 and the ``bits log10 2`` of the arithmetic.

    Source: Stott Parker 1997, section 4.

    Args:
        runs: (N, ...) float64.
        bits: bits of the arithmetic's significand.

    Returns:
        (...) digits.
    """
    return digits_of(runs.std(axis=0, ddof=1), runs.mean(axis=0), bits)


def digits_of(error: Array, value: Array, bits: int) -> Array:
    """``-log10(|error| / |value|)``, from 0 to ``bits log10 2``; where both are 0, the latter."""
    most = bits * np.log10(2)
    with np.errstate(divide="ignore", invalid="ignore"):
        digits = -np.log10(np.abs(error) / np.abs(value))
    return np.clip(np.where(error == 0, most, np.nan_to_num(digits, nan=0.0)), 0, most)


class NamesUsed(Mapping[str, NDArray[Any]]):
    """Weights that record the names that are read.

    Attributes:
        asked: the names, in the order of reading.
    """

    def __init__(self, weights: Weights) -> None:
        self._weights = weights
        self.asked: list[str] = []

    def __getitem__(self, name: str) -> NDArray[Any]:
        self.asked.append(name)
        return self._weights[name]

    def __iter__(self) -> Any:
        return iter(self._weights)

    def __len__(self) -> int:
        return len(self._weights)
