# SPDX-License-Identifier: MIT
"""Frames larger than the memory: strips whose overlap covers what a pixel depends on, with the bits of the whole frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike

from stss_cl.errors import DeviceError

OVERLAP = {False: 128, True: 256}
"""Rows beside a strip's own that are computed with it, without and with Winograd.

An image pixel depends on 106 low-resolution rows to either side: 1 for each convolution at full size, 2, 4 and 8 at the smaller ones, 16
for the attention's window, 15 for the upsampling. With Winograd the *bits* of a pixel depend on its whole tile's input, so that each
convolution of stride 1 counts 4 times, at an eighth of the size twice: 230.
"""
STEP = 32
"""Strips begin at multiples of this: Winograd's tiles of 4 pixels at 1/8 size then lie as in the whole frame."""

CHANNELS = {
    1: 24 * 3 + 4 * 3,
    2: 24 * 3 + 32 * 2,
    4: 24 + 32 * 3 + 96 + 64,
    8: 32 * 3 + 96 * 2 + 64 * 2 + 16,
}
"""Channels of all activations by the divisor of their size (``stss_cl/network/layers.py``)."""


@dataclass(frozen=True)
class Strip:
    """Rows ``top`` .. of the frame are computed, of which the strip's rows ``first`` .. ``last`` - 1 are written."""

    top: int
    first: int
    last: int


def bytes_for(rows: int, width: int, dtype: DTypeLike) -> int:
    """What the network's buffers take for ``rows`` x ``width``, weights, borders, inputs and image left out."""
    size = np.dtype(dtype).itemsize
    return rows * width * 16 + sum(rows // d * (width // d) * channels * size for d, channels in CHANNELS.items())


def rows_within(height: int, width: int, dtype: DTypeLike, limit: int, overlap: int) -> int:
    """The most rows of a strip whose buffers stay below ``limit`` bytes; ``height`` if the whole frame does.

    Args:
        height: of the frame, a multiple of 8.
        width: likewise.
        dtype: of the activations.
        limit: bytes.
        overlap: of ``OVERLAP``.

    Raises:
        DeviceError: not even the smallest strip does.
    """
    if bytes_for(height, width, dtype) <= limit:
        return height
    # The last strip ends with the frame and begins at a multiple of STEP, so all of them have this remainder.
    smallest = 2 * overlap + STEP + height % STEP
    if smallest >= height or bytes_for(smallest, width, dtype) > limit:
        needed = min(bytes_for(min(smallest, height), width, dtype), bytes_for(height, width, dtype))
        raise DeviceError(f"memory limit: {limit / 2**20:.0f} MiB; a frame {width} wide needs at least {needed / 2**20:.0f} MiB")
    rows = smallest
    while rows + STEP < height and bytes_for(rows + STEP, width, dtype) <= limit:
        rows += STEP
    return rows


def strips(height: int, shown: int, rows: int, overlap: int) -> tuple[Strip, ...]:
    """Cover a frame with strips of ``rows`` rows.

    Args:
        height: of the frame, a multiple of 8.
        shown: rows of the frame before it was padded.
        rows: from ``rows_within``.
        overlap: as there.

    Returns:
        Strips in order; every row below ``shown`` is written by exactly one.
    """
    if rows >= height:
        return (Strip(0, 0, shown),)
    made: list[Strip] = []
    written = top = 0
    while written < shown:
        ends = top + rows >= height
        last = shown if ends else (top + rows - overlap) // STEP * STEP
        made.append(Strip(top, written - top, last - top))
        written = last
        top = min(written - overlap, height - rows)
    return tuple(made)
