# SPDX-License-Identifier: MIT
"""Data and display windows: the pixels of a file, and those of the image."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from stss_ref.arrays import Mask


class PixelWindow(NamedTuple):
    """A rectangle of pixels; y points down, and both may be negative.

    Attributes:
        x, y: the first column and row.
        width, height: pixels.
    """

    x: int
    y: int
    width: int
    height: int

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return self.height, self.width

    @property
    def doubled(self) -> PixelWindow:
        """The same rectangle in pixels half as wide."""
        return PixelWindow(2 * self.x, 2 * self.y, 2 * self.width, 2 * self.height)

    def within(self, other: PixelWindow) -> tuple[slice, slice]:
        """Rows and columns of the common part, in an array of ``other``; empty slices if there is none."""
        rows = _overlap(self.y, self.height, other.y, other.height)
        return rows, _overlap(self.x, self.width, other.x, other.width)

    def mask(self, other: PixelWindow) -> Mask:
        """(H, W) of ``other``: True within this window."""
        inside = np.zeros(other.size, np.bool_)
        inside[self.within(other)] = True
        return inside

    def __str__(self) -> str:
        """As OpenEXR's tools print it, both corners included."""
        return f"({self.x}, {self.y}) - ({self.x + self.width - 1}, {self.y + self.height - 1})"


def union(windows: Iterable[PixelWindow]) -> PixelWindow:
    """The smallest window that holds all of ``windows``, at least one."""
    parts = [*windows]
    x, y = min(w.x for w in parts), min(w.y for w in parts)
    return PixelWindow(x, y, max(w.x + w.width for w in parts) - x, max(w.y + w.height for w in parts) - y)


def _overlap(start: int, length: int, other: int, length_other: int) -> slice:
    first = min(max(start - other, 0), length_other)
    return slice(first, max(first, min(start + length - other, length_other)))
