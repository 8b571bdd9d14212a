# SPDX-License-Identifier: MIT
"""Windows over the last axes of (N, C, ...): convolutions, pooling and resizing as plain sums over taps, in any number of axes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

AnyArray = NDArray[Any]


class Window:
    """The geometry of a window: sizes along the spatial axes.

    Args:
        size: of the input.
        kernel, strides, dilations: of the window.
        pads: before each axis, then behind each.
        auto: ONNX's ``auto_pad``; in place of ``pads`` unless ``NOTSET``.
        ceil: ONNX's ``ceil_mode``.
    """

    def __init__(
        self,
        size: Sequence[int],
        kernel: Sequence[int],
        strides: Sequence[int],
        dilations: Sequence[int],
        pads: Sequence[int],
        auto: str = "NOTSET",
        *,
        ceil: bool = False,
    ):
        self.size, self.kernel, self.strides, self.dilations = [*size], [*kernel], [*strides], [*dilations]
        axes = range(len(size))
        self.span = [(kernel[i] - 1) * dilations[i] + 1 for i in axes]
        self.before = [*pads[: len(size)]]
        behind = [*pads[len(size) :]]
        if auto in ("SAME_UPPER", "SAME_LOWER"):
            self.out = [-(-size[i] // strides[i]) for i in axes]
            total = [max((self.out[i] - 1) * strides[i] + self.span[i] - size[i], 0) for i in axes]
            self.before = [t // 2 if auto == "SAME_UPPER" else -(-t // 2) for t in total]
            behind = [t - b for t, b in zip(total, self.before, strict=True)]
        else:
            if auto == "VALID":
                self.before, behind = [0] * len(size), [0] * len(size)
            spare = [size[i] + self.before[i] + behind[i] - self.span[i] for i in axes]
            self.out = [(math.ceil if ceil else math.floor)(spare[i] / strides[i]) + 1 for i in axes]
            if ceil:  # a window that begins in the padding behind is left out
                self.out = [n - 1 if (n - 1) * strides[i] >= size[i] + self.before[i] else n for i, n in enumerate(self.out)]
        if min(self.out, default=1) < 1:
            raise ValueError(f"a window of {self.span} is larger than its input of {self.size}")
        self.behind = [max(behind[i], (self.out[i] - 1) * strides[i] + self.span[i] - size[i] - self.before[i]) for i in axes]
        self.padded = behind

    def pad(self, x: AnyArray, value: float = 0.0) -> AnyArray:
        """``x`` with as much around it as windows reach."""
        around = [(max(b, 0), max(a, 0)) for b, a in zip(self.before, self.behind, strict=True)]
        return np.pad(x, [(0, 0), (0, 0), *around], constant_values=value)

    def pad_counted(self, ones: AnyArray) -> AnyArray:
        """``ones`` with ones where ``pads`` are, and zeros where windows reach beyond them."""
        inside = [(max(b, 0), max(a, 0)) for b, a in zip(self.before, self.padded, strict=True)]
        counted = np.pad(ones, [(0, 0), (0, 0), *inside], constant_values=1.0)
        beyond = [(0, max(a - max(p, 0), 0)) for a, p in zip(self.behind, self.padded, strict=True)]
        return np.pad(counted, [(0, 0), (0, 0), *beyond])

    def taps(self, padded: AnyArray) -> Iterator[tuple[tuple[int, ...], AnyArray]]:
        """Each place in the window, and the numbers that it meets: (N, C, *out)."""
        for tap in product(*map(range, self.kernel)):
            yield tap, padded[(..., *self._slices(tap))]

    def _slices(self, tap: Sequence[int]) -> list[slice]:
        starts = [t * d for t, d in zip(tap, self.dilations, strict=True)]
        return [slice(a, a + (n - 1) * s + 1, s) for a, n, s in zip(starts, self.out, self.strides, strict=True)]

    def convolve(self, x: AnyArray, w: AnyArray, groups: int) -> AnyArray:
        """(N, M, *out) of ``x`` (N, C, *size) and ``w`` (M, C / groups, *kernel)."""
        n, outputs = len(x), len(w)
        w = w.reshape(groups, outputs // groups, -1, *self.kernel)
        total = np.zeros((n, groups, outputs // groups, math.prod(self.out)))
        for tap, there in self.taps(self.pad(x)):
            total += w[(..., *tap)] @ there.reshape(n, groups, -1, total.shape[-1])
        return total.reshape(n, outputs, *self.out)

    def spread(self, x: AnyArray, w: AnyArray, groups: int, size: Sequence[int]) -> AnyArray:
        """The transpose: (N, M, *size) of ``x`` (N, C, *out) and ``w`` (C, M / groups, *kernel); values in the pads are cut off."""
        n, inputs, each = len(x), len(w), w.shape[1]
        w = w.reshape(groups, inputs // groups, each, *self.kernel)
        full = [
            max(s + b, (o - 1) * t + k)
            for s, b, o, t, k in zip(size, self.before, self.out, self.strides, self.span, strict=True)
        ]
        total = np.zeros((n, groups * each, *full))
        columns = x.reshape(n, groups, inputs // groups, -1)
        for tap in product(*map(range, self.kernel)):
            part = np.swapaxes(w[(..., *tap)], 1, 2) @ columns
            total[(..., *self._slices(tap))] += part.reshape(n, groups * each, *self.out)
        return total[(..., *(slice(b, b + s) for b, s in zip(self.before, size, strict=True)))]


TRANSFORMATIONS = ("half_pixel", "pytorch_half_pixel", "align_corners", "asymmetric", "half_pixel_symmetric")


def coordinates(mode: str, length: int, before: int, scale: float) -> AnyArray:
    """Where the numbers of a resized axis lie on the original one, by ONNX's ``coordinate_transformation_mode``."""
    i = np.arange(length, dtype=np.float64)
    if mode == "half_pixel":
        return (i + 0.5) / scale - 0.5
    if mode == "pytorch_half_pixel":
        return (i + 0.5) / scale - 0.5 if length > 1 else i * 0
    if mode == "align_corners":
        return i * ((before - 1) / (length - 1)) if length > 1 else i * 0
    if mode == "asymmetric":
        return i / scale
    adjustment = length / (before * scale)  # half_pixel_symmetric
    return before / 2 * (1 - adjustment) + (i + 0.5) / scale - 0.5


def nearest(at: AnyArray, mode: str) -> AnyArray:
    """The nearest number by ONNX's ``nearest_mode``."""
    if mode == "round_prefer_floor":
        return np.ceil(at - 0.5)
    if mode == "round_prefer_ceil":
        return np.floor(at + 0.5)
    return np.floor(at) if mode == "floor" else np.ceil(at)
