# SPDX-License-Identifier: MIT
"""Type names for arrays, and the checks that every stage makes of its inputs.

All arrays are channels last, ``(H, W, C)``, indexed ``[y, x]`` (spec section 0). A stage runs in the dtype it is given: float32, or
float64, which is the truth.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from string import ascii_letters as LETTERS  # noqa: N812
from string import digits as DIGITS  # noqa: N812
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
"""Any array of floating point numbers."""
Image = Array
"""(H, W, C)."""
Plane = Array
"""(H, W)."""
Mask = NDArray[np.bool_]
"""(H, W) of bool; its name says what True means."""


FLOATS = (np.dtype(np.float32), np.dtype(np.float64))
"""The dtypes of a stage."""


class Shaped(Protocol):
    """The two attributes that the checks of shape and dtype read, so that arrays of other libraries can be checked too."""

    @property
    def shape(self) -> tuple[int, ...]: ...  # noqa: D102

    @property
    def dtype(self) -> Any: ...  # noqa: D102


class ArrayError(ValueError):
    """An array does not fit a stage; the message names it, the expected and the found value."""


def require(
    arrays: Mapping[str, tuple[Any, str]], *, non_finite: Collection[str] = (), masks: Collection[str] = ()
) -> dict[str, int]:
    """Check a function's arrays: shapes, one dtype, finite numbers. The error names the first array that does not fit.

    Args:
        arrays: name -> the array, and its shape in the words of docstrings: ``H, W, 3``. A letter stands for one length of at least 1,
            the same wherever it occurs, and ``8H`` for eight times that.
        non_finite: names of arrays that may hold NaN and infinities: motion and position (decision 3).
        masks: names of arrays that may also be bool or uint8.

    Returns:
        The lengths, by letter.

    Raises:
        ArrayError: an array is not what the function takes.
    """
    lengths: dict[str, int] = {}
    first: tuple[str, Any] | None = None
    for name, (array, words) in arrays.items():
        # "8H" -> (8, "H"), "3" -> (3, "")
        axes = [(int(word.rstrip(LETTERS) or 1), word.lstrip(DIGITS)) for word in words.split(", ")]
        require_shape(
            name, array, tuple(n * lengths[letter] if letter in lengths else None if letter else n for n, letter in axes)
        )
        for (n, letter), length in zip(axes, array.shape, strict=True):
            if letter:
                lengths.setdefault(letter, length // n)
        require_shape(name, array, tuple(n * lengths[letter] if letter else n for n, letter in axes))
        if name in masks and array.dtype in (np.bool_, np.uint8):
            continue
        if array.dtype not in FLOATS:
            raise ArrayError(f"{name}: expected dtype float32 or float64, got {array.dtype}")
        first = first or (name, array.dtype)
        if array.dtype != first[1]:
            raise ArrayError(f"{name}: expected dtype {first[1]}, that of {first[0]}, got {array.dtype}")
        if name not in non_finite:
            require_finite(name, array)
    return lengths


def require_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Raise ArrayError unless ``value`` is one of the words."""
    if not isinstance(value, str) or value not in choices:
        got = repr(value) if isinstance(value, str) else type(value).__name__
        raise ArrayError(f"{name}: expected {' or '.join(choices)}, got {got}")


def require_shape(name: str, array: Shaped, shape: tuple[int | None, ...]) -> None:
    """Raise ArrayError unless ``array`` has ``shape``; None stands for any length of at least 1."""
    if not isinstance(getattr(array, "shape", None), tuple):
        raise ArrayError(f"{name}: expected an array, got {type(array).__name__}")
    fits = len(array.shape) == len(shape) and all(
        got == want if want is not None else got >= 1 for got, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        wanted_shape = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
        raise ArrayError(f"{name}: expected shape {wanted_shape}, got {array.shape}")


def require_dtype(name: str, array: Shaped, dtype: np.dtype[Any]) -> None:
    """Raise ArrayError unless ``array`` has ``dtype``."""
    if array.dtype != dtype:
        raise ArrayError(f"{name}: expected dtype {dtype}, got {array.dtype}")


def require_finite(name: str, array: Array) -> None:
    """Raise ArrayError if ``array`` holds NaN or an infinity; the message has their number and the index of the first."""
    finite = np.isfinite(array)
    if not finite.all():
        bad = ~finite
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ArrayError(f"{name}: {int(bad.sum())} non-finite values, first at index {first}")
