# SPDX-License-Identifier: MIT
"""The arithmetic of a port: its unit roundoff, the numbers it has exactly, and its largest error in following a motion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.protocol.port import Arrays
from conformance.tolerance import BOUNDS, UNIT
from stss_ref.arrays import Plane
from stss_ref.sample import Index, Place, Taps, follow, taps

LIMITS = {
    **{
        name: tuple(float(n) for n in (i.max, i.tiny, i.smallest_subnormal))
        for name, i in ((name, np.finfo(name)) for name in ("float32", "float16"))
    },
    "bfloat16": ((2 - 2.0**-7) * 2.0**127, 2.0**-126, 2.0**-133),
}
"""The largest number, the smallest normal number and the smallest number of each arithmetic."""
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Arithmetic:
    """The arithmetic of a port.

    Attributes:
        dtype: ``float32``, ``float16`` or ``bfloat16``, in which its numbers are stored; a port in 16 bits
            computes with at least float32's range.
        winograd: it computes 3 x 3 convolutions by Winograd's algorithm, up to F(4x4).
    """

    dtype: str = "float32"
    winograd: bool = False

    @property
    def unit(self) -> float:
        """Unit roundoff ``u``."""
        return UNIT[self.dtype]

    @property
    def tiny(self) -> float:
        """Smallest normal number; smaller numbers may become 0."""
        return LIMITS[self.dtype][1]

    @property
    def spacing(self) -> float:
        """Distance between the smallest numbers, the largest loss of storing a small number."""
        return LIMITS[self.dtype][2]

    def flushed(self, x: NDArray[Any]) -> Float64:
        """Largest error of copying ``x``: a denormal number may become 0."""
        return np.where(np.abs(x) < self.tiny, self.tiny, 0.0)

    def holds(self, x: Float64) -> Bool:
        """Where ``x`` is a number that the arithmetic has exactly."""
        with np.errstate(over="ignore"):
            return np.asarray(self._store(x) == x)

    def rounded(self, x: NDArray[Any], most: float | None = None) -> NDArray[Any]:
        """``x`` rounded to the port's numbers, as float32, finite where ``x`` is and at most ``most``; other kinds unchanged."""
        if x.dtype.kind != "f" or (most is None and x.dtype == np.float32 and self.dtype == "float32"):
            return np.ascontiguousarray(x)
        most = LIMITS[self.dtype][0] if most is None else most
        with np.errstate(over="ignore"):
            numbers = self._store(np.where(np.isfinite(x), np.clip(x, -most, most), x))
        return np.ascontiguousarray(numbers.astype(np.float32))

    def normal(self, x: NDArray[Any]) -> NDArray[Any]:
        """`rounded`, and 0 for subnormal numbers: a port may have 0 there, and the direction of a key of such numbers is lost.

        ``x`` itself where no number changes, so that weights that share arrays go on doing so.
        """
        numbers = self.rounded(x)
        lost = (np.abs(numbers) < self.tiny) & (numbers != 0)
        return np.where(lost, numbers.dtype.type(0), numbers) if lost.any() else numbers

    def _store(self, x: NDArray[Any]) -> NDArray[Any]:
        """``x`` in the arithmetic's numbers, the nearest, ties to even."""
        if self.dtype != "bfloat16":
            return x.astype(self.dtype)
        bits = x.astype(np.float32).view(np.uint32)
        nearest = (bits + 0x7FFF + (bits >> 16 & 1) & 0xFFFF0000).view(np.float32)
        return np.where(np.isnan(x), np.float32(np.nan), nearest)


def in_float64(arrays: Arrays) -> dict[str, NDArray[Any]]:
    """The same numbers in float64, for the reference; masks and integers as they are."""
    return {name: array.astype(np.float64, copy=False) if array.dtype.kind == "f" else array for name, array in arrays.items()}


@dataclass(frozen=True)
class Reach:
    """The places where motion leads, and the errors of a port's motion and of its fraction: all (H, W)."""

    at: Place
    off_x: Float64
    off_y: Float64
    rounded_x: Float64
    rounded_y: Float64

    @cached_property
    def cell(self) -> Taps:
        """The four pixels around each place."""
        return taps(self.at)

    @cached_property
    def unsure(self) -> Bool:
        """Where a port may read another cell of pixels than the place's own; rounding only the fraction changes no cell."""
        return _near_whole(self.at.fx, self.off_x) | _near_whole(self.at.fy, self.off_y)

    @cached_property
    def slip(self) -> Float64:
        """Largest distance from the place at which a port may read, the sum of both axes; pixels."""
        return self.off_x + self.off_y + self.rounded_x + self.rounded_y


def reach(motion: NDArray[Any], arithmetic: Arithmetic, off: Float64 | float = 0.0) -> Reach:
    """``p + floor(motion)`` and ``motion - floor(motion)``, and their errors.

    Whole pixels are exact, and so is a fraction that the arithmetic has. Other fractions, of motion between -1 and 0, have an error of
    up to the row ``fraction``.

    Args:
        motion: (H, W, 2) pixels.
        arithmetic: of the port.
        off: (H, W, 2) largest error of the port's motion itself; pixels.
    """
    at = follow(motion)
    fraction = np.stack([at.fx, at.fy], axis=-1).astype(np.float64)
    rounded = np.where(arithmetic.holds(fraction), 0, BOUNDS["fraction"].roundings * arithmetic.unit * fraction)
    wrong = off + np.where(motion == 0, 0, arithmetic.flushed(motion))
    return Reach(at, wrong[..., 0], wrong[..., 1], rounded[..., 0], rounded[..., 1])


def sum_error(total: NDArray[Any], off: Float64 | float, arithmetic: Arithmetic) -> Float64:
    """Error that rounding adds to a sum of motions: 0 where the terms are exact and the arithmetic has the sum exactly."""
    exact = (np.broadcast_to(off, total.shape) == 0) & arithmetic.holds(total)
    return np.where(exact, 0, BOUNDS["sum"].roundings * arithmetic.unit * np.abs(total))


def may_lead(whole: NDArray[Any], fraction: NDArray[Any], off: Float64, size: int) -> tuple[Index, Float64]:
    """The places, each a whole pixel and a fraction, where motion that is off by up to ``off`` may lead along an axis of ``size`` pixels.

    Args:
        whole, fraction, off: (N,) each.

    Returns:
        (3, N) each, in order, the place itself in the middle; one pixel beyond the frame is as good as any distance.
    """
    moved = np.stack([fraction - off, fraction, fraction + off])
    steps = np.where(off > 0, np.floor(moved), 0)
    steps[1] = 0  # also where the fraction is 1 by rounding
    return np.clip(whole + steps, -2, size).astype(np.intp), moved - steps


def _near_whole(fraction: Plane, off: Float64) -> Bool:
    return (off > 0) & ((fraction - off < 0) | (fraction + off >= 1))
