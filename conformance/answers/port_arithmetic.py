# SPDX-License-Identifier: MIT
"""What a port computes in: its unit roundoff, what it holds exactly, and how far it may be from where a motion leads."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.tolerance import BOUNDS, UNIT
from stss_ref.arrays import Plane
from stss_ref.sample import Place, follow

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Arithmetic:
    """Of a port.

    Attributes:
        dtype: ``float32`` or ``float16``, which its numbers are stored in; a float16 port has at least float32's range in between.
        winograd: whether it computes 3 x 3 convolutions in Winograd's way, up to F(4x4).
    """

    dtype: str = "float32"
    winograd: bool = False

    @property
    def unit(self) -> float:
        """Unit roundoff ``u``."""
        return UNIT[self.dtype]

    @property
    def tiny(self) -> float:
        """Smallest normal number: what is below it may have become 0."""
        return float(np.finfo(self.dtype).tiny)

    @property
    def spacing(self) -> float:
        """Distance of the smallest numbers: what storing a small one may lose."""
        return float(np.finfo(self.dtype).smallest_subnormal)

    def flushed(self, x: NDArray[Any]) -> Float64:
        """What copying ``x`` may be off by: a number too small to be normal may become 0."""
        return np.where(np.abs(x) < self.tiny, self.tiny, 0.0)

    def holds(self, x: Float64) -> Bool:
        """Where ``x`` is one of its numbers."""
        with np.errstate(over="ignore"):
            return np.asarray(x.astype(self.dtype) == x)

    def rounded(self, x: NDArray[Any], most: float | None = None) -> NDArray[Any]:
        """``x`` as float32 numbers that the port holds: the nearest, finite where ``x`` is, at most ``most``; other kinds as they are."""
        if x.dtype.kind != "f" or (most is None and x.dtype == np.float32 and self.dtype == "float32"):
            return np.ascontiguousarray(x)
        most = float(np.finfo(self.dtype).max) if most is None else most
        with np.errstate(over="ignore"):
            held = np.where(np.isfinite(x), np.clip(x, -most, most), x).astype(self.dtype)
        return np.ascontiguousarray(held.astype(np.float32))


@dataclass(frozen=True)
class Reach:
    """Where motion leads, how far a port's motion may be off, and what it may round of the fraction: all (H, W)."""

    at: Place
    off_x: Float64
    off_y: Float64
    rounded_x: Float64
    rounded_y: Float64

    @property
    def unsure(self) -> Bool:
        """Where another cell of pixels than the place's own may be read: rounding the fraction leads to none."""
        return _near_whole(self.at.fx, self.off_x) | _near_whole(self.at.fy, self.off_y)

    @property
    def slip(self) -> Float64:
        """How far from the place a port may read, both axes together."""
        return self.off_x + self.off_y + self.rounded_x + self.rounded_y


def reach(motion: Float64, arithmetic: Arithmetic, off: Float64 | float = 0.0) -> Reach:
    """``p + floor(motion)`` and ``motion - floor(motion)``, and their errors.

    Whole pixels are exact, and so is a fraction that the arithmetic holds; any other, of a motion between -1 and 0, may be off by
    the row ``fraction``.

    Args:
        motion: (H, W, 2) pixels.
        arithmetic: of the port.
        off: (H, W, 2) how far the port's motion itself may be off.
    """
    at = follow(motion)
    fraction = np.stack([at.fx, at.fy], axis=-1).astype(np.float64)
    rounded = np.where(arithmetic.holds(fraction), 0, BOUNDS["fraction"].roundings * arithmetic.unit * fraction)
    wrong = off + np.where(motion == 0, 0, arithmetic.flushed(motion))
    return Reach(at, wrong[..., 0], wrong[..., 1], rounded[..., 0], rounded[..., 1])


def sum_error(total: Float64, off: Float64 | float, arithmetic: Arithmetic) -> Float64:
    """What rounding a sum of motions adds: nothing where its terms are exact and the arithmetic holds it."""
    exact = (np.broadcast_to(off, total.shape) == 0) & arithmetic.holds(total)
    return np.where(exact, 0, BOUNDS["sum"].roundings * arithmetic.unit * np.abs(total))


def ways(whole: int, fraction: float, off: float) -> list[tuple[int, float]]:
    """The places, each a whole pixel and a fraction, where a motion may lead along an axis that may be off by so much."""
    found = [(whole, fraction)]
    for moved in (fraction - off, fraction + off) if off > 0 else ():
        found.append((whole + math.floor(moved), moved - math.floor(moved)))
    return found


def _near_whole(fraction: Plane, off: Float64) -> Bool:
    return (off > 0) & ((fraction - off < 0) | (fraction + off >= 1))
