# SPDX-License-Identifier: MIT
"""Check the buffers of a display frame before anything is computed from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from stss.frames.buffers import Buffers
from stss.images.read_write import WHOLE
from stss_ground.arguments import require_kind
from stss_ground.errors import InputError
from stss_ref.arrays import Array, Mask


class _Plane(NamedTuple):
    """The requirements on a plane.

    Attributes:
        channels: its last axis; 0: it has two axes.
        least, most: its range; None: any finite number.
        otherwise: values allowed beside finite numbers: "", "inf" or "any".
        hint: advice for a wrong plane.
    """

    channels: int
    least: float | None = None
    most: float | None = None
    otherwise: str = ""
    hint: str = ""

    @property
    def slack(self) -> float:
        """Allowed distance of a value from its range."""
        return ROUNDING if self.most == 1 else 0.0


def float_hint(dtype: np.dtype[Any]) -> str:
    """How to convert a plane of integers to floating-point numbers."""
    most = {"uint8": "8-bit values by 255", "uint16": "16-bit values by 65535"}.get(dtype.name, "values by the one that means 1")
    return f"divide {most}"


_UNIT = float_hint(np.dtype(np.uint8))
_PLANES = {
    "color": _Plane(3, hint="replace NaN and Inf before the call"),
    "motion": _Plane(2, otherwise="any"),
    "normal": _Plane(3, -2, 2, hint="world space, unit length, 0 where nothing was hit"),
    "depth": _Plane(0, 0, None, "inf", "linear view depth, infinite where nothing was hit"),
    "position": _Plane(3, otherwise="any"),
    "stencil": _Plane(0, 0, hint="an object's number, 0 for static geometry"),
    "nov": _Plane(0, -2, 2, hint="dot of normal and view vector"),
    "base_color": _Plane(3, 0, 1, hint=_UNIT),
    "roughness": _Plane(0, 0, 1, hint=_UNIT),
    "metallic": _Plane(0, 0, 1, hint=_UNIT),
}
ROUNDING = 2.0**-8
"""Largest distance of a plane in [0, 1] from this range: a step of 8 bits, which filters and rounding cause."""


def check_buffers(buffers: Buffers) -> None:
    """Raise InputError for the first plane that does not fit `Buffers`: dtype, shape, range, finite values.

    The message names the plane, the frame, what was expected, what was found and where.
    """
    require_kind("frame", buffers, Buffers, "Buffers")
    require_kind("number", buffers.number, (int, np.integer), "a frame's number")
    require_kind(f"frame {buffers.number}: carried", buffers.carried, Mapping, "names and planes")
    height, width = _size(buffers)
    for name, plane in _PLANES.items():
        array = getattr(buffers, name)
        if name == "color" and array is None:
            continue
        _check(f"frame {buffers.number}: {name}", array, (height, width, plane.channels)[: 3 if plane.channels else 2], plane)
    for name, array in buffers.carried.items():
        channels = array.shape[-1] if np.ndim(array) == 3 else 1
        _check(f"frame {buffers.number}: {name}", array, (height, width, channels), _Plane(channels))


def require_unmasked(where: str, array: object) -> None:
    """Raise InputError where a masked array hides a value: it would be read."""
    if np.ma.is_masked(array):
        raise InputError(
            f"{where}: expected an array without a mask, found one that hides values; fill it first: array.filled(0)"
        )


def require_distinct(where: str, numbers: Array, floats: Array) -> None:
    """Raise InputError where ``numbers`` of objects run together in ``floats``, their 32-bit floats; narrower floats cannot."""
    if np.issubdtype(numbers.dtype, np.floating) and numbers.dtype.itemsize <= floats.dtype.itemsize:
        return
    bad = (numbers > WHOLE) & (floats.astype(np.float64) != numbers)
    if bad.any():
        raise _error(
            where, f"whole numbers up to {WHOLE}, beyond which 32-bit floats merge them", numbers, bad, _PLANES["stencil"]
        )


def _size(buffers: Buffers) -> tuple[int, int]:
    depth = buffers.depth
    if not isinstance(depth, np.ndarray) or depth.ndim != 2 or 0 in depth.shape:
        got = depth.shape if isinstance(depth, np.ndarray) else type(depth).__name__
        raise InputError(f"frame {buffers.number}: depth: expected an array (H, W), found {got}")
    return depth.shape[0], depth.shape[1]


def _check(where: str, array: Array, shape: tuple[int, ...], plane: _Plane) -> None:
    if not isinstance(array, np.ndarray):
        raise InputError(f"{where}: expected an array {shape}, found {type(array).__name__}")
    if array.dtype.kind not in ("fiub" if where.endswith(": stencil") else "f"):
        kind, hint = (
            ("numbers", plane.hint) if where.endswith(": stencil") else ("floating-point numbers", float_hint(array.dtype))
        )
        raise InputError(f"{where}: expected {kind}, found {array.dtype}; {hint}")
    if array.shape != shape:
        raise InputError(f"{where}: expected shape {shape}, found {array.shape}")
    require_unmasked(where, array)
    if where.endswith(": stencil"):
        require_distinct(where, array, array.astype(np.float32, copy=False))
    if plane.otherwise == "any" or _is_within(np.asarray(array), plane):
        return
    bad = np.isnan(array) if plane.otherwise == "inf" else ~np.isfinite(array)
    if bad.any():
        raise _error(where, "finite numbers" if plane.otherwise == "" else "numbers", array, bad, plane)
    if plane.least is not None:
        bad = array <= 0 if plane.otherwise == "inf" else array < plane.least - plane.slack
        if bad.any():
            expected = f"values {'>' if plane.otherwise == 'inf' else '>='} {plane.least:g}"
            raise _error(where, expected, array, bad, plane if plane.most != 1 else plane._replace(hint=""))
    if plane.most is not None and (bad := array > plane.most + plane.slack).any():
        raise _error(where, f"values <= {plane.most:g}", array, bad, plane)


def _is_within(array: Array, plane: _Plane) -> bool:
    """Whether every value fits, by the smallest and the largest, which are NaN where a value is: two passes without a mask."""
    if not array.size:
        return True
    low, high = array.min(), array.max()
    if plane.otherwise == "inf":
        return bool(low > 0)
    fits = np.isfinite(low) and np.isfinite(high)
    if plane.least is not None:
        fits = fits and low >= plane.least - plane.slack
    return bool(fits and (plane.most is None or high <= plane.most + plane.slack))


def _error(where: str, expected: str, array: Array, bad: Mask, plane: _Plane) -> InputError:
    first = tuple(int(i) for i in np.argwhere(bad)[0])
    count = int(bad.sum())
    rest = f" and {count - 1} more" if count > 1 else ""
    hint = f"; {plane.hint}" if plane.hint else ""
    return InputError(f"{where}: expected {expected}, found {array[first]:g} at {first}{rest}{hint}")
