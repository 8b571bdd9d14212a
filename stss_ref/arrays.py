# SPDX-License-Identifier: MIT
"""Type names for arrays, and the checks that every stage makes of its inputs.

All arrays are channels last, ``(H, W, C)``, indexed ``[y, x]`` (spec section 0). A stage runs in the dtype it is given: float32, or
float64, which is the truth.
"""

from __future__ import annotations

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


class Shaped(Protocol):
    """The two attributes that the checks of shape and dtype read, so that arrays of other libraries can be checked too."""

    @property
    def shape(self) -> tuple[int, ...]: ...  # noqa: D102

    @property
    def dtype(self) -> Any: ...  # noqa: D102


class ArrayError(ValueError):
    """An array is not what a stage takes; the message names it, what was expected and what was found."""


def require_shape(name: str, array: Shaped, shape: tuple[int | None, ...]) -> None:
    """Raise ArrayError unless ``array`` has ``shape``; None stands for any length of at least 1."""
    if not isinstance(getattr(array, "shape", None), tuple):
        raise ArrayError(f"{name}: expected an array, got {type(array).__name__}")
    fits = len(array.shape) == len(shape) and all(
        got == want if want is not None else got >= 1 for got, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        expected = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
        raise ArrayError(f"{name}: expected shape {expected}, got {array.shape}")


def require_dtype(name: str, array: Shaped, dtype: np.dtype[Any]) -> None:
    """Raise ArrayError unless ``array`` has ``dtype``."""
    if array.dtype != dtype:
        raise ArrayError(f"{name}: expected dtype {dtype}, got {array.dtype}")


def require_finite(name: str, array: Array) -> None:
    """Raise ArrayError if ``array`` holds NaN or an infinity; the message has their number and the index of the first."""
    bad = ~np.isfinite(array)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ArrayError(f"{name}: {int(bad.sum())} non-finite values, first at index {first}")
