# SPDX-License-Identifier: MIT
"""Monte Carlo arithmetic on the reference, which does not know of it.

The reference is NumPy from its inputs to its image, and NumPy hands every operation on a subclass of its array to that subclass. So a
`Watched` array, given to a stage in place of an array, sees every operation the stage computes: it lets NumPy do it in float64 and shows
the result to its watcher. `StochasticRounding` rounds it up or down at random to 24 or 11 bits; `Trace` only notes it.

A matrix product counts as one operation. What is exact in so many bits (a comparison, a maximum, a difference of neighbours) stays exact,
as in a machine. Exponents have no limits: overflow and subnormal numbers are `stss.stress.hard_image_cases`'.

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
"""What is rounded: every operation; or what a convolution or the attention is about to read, which is what a backend stores."""


FLOATS = (np.dtype(np.float64), np.dtype(np.float32))
"""What is watched; indices and comparisons are not."""


class Watcher:
    """Is shown what a stage computes, and may change it in place."""

    def result(self, array: Array) -> None:
        """Of one operation."""

    def padded(self, array: Array) -> None:
        """What is about to be surrounded by zeros: the input of a convolution, the keys and values of the attention."""


class StochasticRounding(Watcher):
    """Rounds float64 to a number of bits, up or down at random, so that the expected result is the exact one.

    Args:
        bits: of the significand; 24 as float32, 11 as half.
        seed: of the dice.
        where: what is rounded.
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
        # In the bits: adding a random part of what is lost carries as often as that part is large; then it is cut off.
        bits = array.view(np.int64)
        dice = self._random.integers(0, 1 << self._lost, array.shape)
        bits += np.where(np.isfinite(array), dice, 0)
        bits &= -(1 << self._lost)


class Trace(Watcher):
    """Notes what each convolution reads.

    Attributes:
        read: in the order of computation.
    """

    def __init__(self) -> None:
        self.read: list[Array] = []

    def padded(self, array: Array) -> None:
        """See ``Watcher``."""
        self.read.append(array.copy())


class Watched(np.ndarray[Any, np.dtype[Any]]):
    """An array whose every result is shown to a watcher; results are watched too, where they are floats."""

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
    """The inputs of a stage in ``dtype`` (integers and masks as they are), shown to ``watcher`` from now on."""
    return {n: _watch(a.astype(dtype), watcher) if a.dtype.kind == "f" else a for n, a in inputs.items()}


def samples(stage: str, inputs: Arrays, weights: Weights, make: Callable[[int], Watcher], count: int) -> dict[str, Array]:
    """A stage computed ``count`` times, each time rounded by other dice.

    Args:
        stage: of ``conformance.protocol.stages.STAGES``.
        inputs: what it takes, of any float dtype.
        weights: the 92 tensors.
        make: the watcher of the i-th time.
        count: how often.

    Returns:
        Of each output (count, ...) float64.
    """
    runs = [reference(stage, watched(inputs, make(i)), weights) for i in range(count)]
    return {name: np.stack([run[name] for run in runs]) for name in runs[0]}


def significant_digits(runs: Array, bits: int) -> Array:
    """Decimal digits that the runs agree in: ``s = -log10(sigma / |mu|)``, from 0 to the ``bits log10 2`` that there are.

    Source: Stott Parker 1997, section 4.

    Args:
        runs: (N, ...) float64.
        bits: of the arithmetic.

    Returns:
        (...).
    """
    return digits_of(runs.std(axis=0, ddof=1), runs.mean(axis=0), bits)


def digits_of(error: Array, value: Array, bits: int) -> Array:
    """``-log10(|error| / |value|)``, from 0 to ``bits log10 2``; where both are 0, the latter."""
    most = bits * np.log10(2)
    with np.errstate(divide="ignore", invalid="ignore"):
        digits = -np.log10(np.abs(error) / np.abs(value))
    return np.clip(np.where(error == 0, most, np.nan_to_num(digits, nan=0.0)), 0, most)


class NamesUsed(Mapping[str, NDArray[Any]]):
    """Weights that note the names they are asked for.

    Attributes:
        asked: in the order of asking.
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
