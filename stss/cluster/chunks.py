# SPDX-License-Identifier: MIT
"""Cut a run into chunks: anywhere, since an output depends on six display frames and on no earlier output."""

from __future__ import annotations

from collections.abc import Sequence

LEAST, MOST = 8, 64
"""Frames of a chunk. Each chunk reads five frames more than it writes and computes its first frame with nothing to reuse: with 8 frames
it reads two thirds more. With 64, a machine that dies costs a minute or two."""


def cut(numbers: Sequence[int], workers: int) -> list[Sequence[int]]:
    """Cut ``numbers`` into consecutive pieces, large ones first: each round shares out half of the rest, so that all workers end together.

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
