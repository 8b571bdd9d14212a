# SPDX-License-Identifier: MIT
"""What a port computes in: its unit roundoff, what it holds exactly, and how far a position may be off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.tolerance import BOUNDS, UNIT
from stss_ref.sample import grid

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
        if x.dtype.kind != "f":
            return np.ascontiguousarray(x)
        most = float(np.finfo(self.dtype).max) if most is None else most
        with np.errstate(over="ignore"):
            held = np.where(np.isfinite(x), np.clip(x, -most, most), x).astype(self.dtype)
        return np.ascontiguousarray(held.astype(np.float32))


@dataclass(frozen=True)
class Reach:
    """Where motion leads: position (H, W) in pixels, how far a port may be off, and whether the motion was finite."""

    x: Float64
    y: Float64
    off_x: Float64
    off_y: Float64
    finite: Bool

    @property
    def unsure(self) -> Bool:
        """Where another cell of pixels than the position's own may be read."""
        return _near_whole(self.x, self.off_x) | _near_whole(self.y, self.off_y)


def reach(motion: Float64, arithmetic: Arithmetic, off: Float64 | float = 0.0) -> Reach:
    """``p + motion(p)`` and its error.

    A sum that the arithmetic holds exactly has no error, so that whole and half pixels stay strict; any other may be off by the
    row ``position``.

    Args:
        motion: (H, W, 2) pixels.
        arithmetic: of the port.
        off: (H, W, 2) how far the port's motion itself may be off.
    """
    height, width, _ = motion.shape
    finite: Bool = np.asarray(np.isfinite(motion).all(axis=-1))
    pixel = np.stack(grid(height, width, motion.dtype), axis=-1).astype(np.float64)
    position: Float64 = pixel + np.where(finite[..., None], motion, 0)
    wrong = off + position_error(position, off, arithmetic)
    return Reach(position[..., 0], position[..., 1], wrong[..., 0], wrong[..., 1], finite)


def position_error(position: Float64, off: Float64 | float, arithmetic: Arithmetic) -> Float64:
    """What rounding a position adds, be it ``p + m`` or ``(p + 1/2) + m - 1/2``: nothing where both are exact."""
    exact = (np.broadcast_to(off, position.shape) == 0) & arithmetic.holds(position) & arithmetic.holds(position + 0.5)
    return np.where(exact, 0, BOUNDS["position"].roundings * arithmetic.unit * (np.abs(position) + 1))


def sum_error(total: Float64, off: Float64 | float, arithmetic: Arithmetic) -> Float64:
    """What rounding a sum of motions adds: nothing where its terms are exact and the arithmetic holds it."""
    exact = (np.broadcast_to(off, total.shape) == 0) & arithmetic.holds(total)
    return np.where(exact, 0, BOUNDS["sum"].roundings * arithmetic.unit * np.abs(total))


def _near_whole(x: Float64, off: Float64) -> Bool:
    return (off > 0) & (np.floor(x - off) != np.floor(x + off))
