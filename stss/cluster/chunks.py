# SPDX-License-Identifier: MIT
"""How a run is cut: an output depends on six display frames and on no earlier output, so anywhere."""

from __future__ import annotations

from collections.abc import Sequence

LEAST, MOST = 8, 64
"""Frames of a chunk. Each chunk reads five frames more than it writes, and computes its first frame without what a frame before leaves
behind: at 8 that is two thirds more reading. At 64 a machine that dies costs a minute or two."""


def cut(numbers: Sequence[int], workers: int) -> list[Sequence[int]]:
    """Consecutive pieces of ``numbers``, large ones first: half of what is left is shared out each time, so that all end together.

    Every display frame counts alike: a supersampled and an extrapolated one take the same time to within a few percent.

    Args:
        numbers: display frames in order, not empty.
        workers: at least 1.
    """
    pieces: list[Sequence[int]] = []
    start = 0
    while start < len(numbers):
        size = min(MOST, max(LEAST, (len(numbers) - start) // (2 * workers)))
        pieces.append(numbers[start : start + size])
        start += size
    return pieces
