# SPDX-License-Identifier: MIT
"""Frames larger than the memory: strips that overlap by the reach of a pixel's dependence, with the bits of the whole frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import DTypeLike

from stss_cl.device.buffers import map_bytes, padded_bytes
from stss_cl.device.parts import whole_pages
from stss_cl.network.plan import Plan, plan_network
from stss_ground.errors import DeviceError

OVERLAP = {False: 128, True: 256}
"""Rows on either side that are computed with a strip, without and with Winograd.

An image pixel depends on 106 low-resolution rows to either side: 1 for each convolution at full size, 2, 4 and 8 at the smaller ones, 16
for the attention's window, 15 for the upsampling. With Winograd the *bits* of a pixel depend on its whole tile's input, so that each
convolution of stride 1 counts 4 times, at an eighth of the size twice: 230.
"""
STEP = 32
"""Strips begin at multiples of this: Winograd's tiles of 4 pixels at 1/8 size then lie as in the whole frame."""

BASE, IMAGE = 16, 48
"""Bytes for each pixel: of the decoder's base; of the image."""
MOTIONS, HOLES = 3 * 8, 2 * 16 + 2
"""The same for ``stss_cl.image_space.prepare``: of motions; of samples and lights for holes (a splat takes less), the mask and dirty
tiles."""
WEIGHTS = 8 << 20
"""Bytes of the weights, transformed for Winograd; rounded up."""


@dataclass(frozen=True)
class Strip:
    """Rows ``top`` .. of the frame are computed, of which the strip's rows ``first`` .. ``last`` - 1 are written."""

    top: int
    first: int
    last: int


def bytes_for(rows: int, height: int, width: int, dtype: DTypeLike, *, keep: bool = False, plan: Plan | None = None) -> int:
    """Bytes that a network and its frames take on a device, without the caller's display frames.

    Args:
        rows: rows of a strip; ``height`` where the frame is not divided.
        height, width: of the frame, multiples of 8.
        dtype: of the activations.
        keep: whether each layer keeps its output, with a change map.
        plan: of the network; None: the one that takes most.
    """
    total = rows * width * BASE + height * width * IMAGE + bytes_to_prepare(height, width) + WEIGHTS
    for slot in (plan or _largest(keep)).slots:
        size = rows // slot.divisor, width // slot.divisor, slot.channels
        total += whole_pages(padded_bytes(*size, np.dtype(dtype), slot.images))
        total += keep * map_bytes(*size[:2], slot.images)
    return total


def bytes_to_prepare(height: int, width: int) -> int:
    """Bytes of the buffers of ``stss_cl.image_space.prepare``, whatever fills the holes, without the network's inputs."""
    return whole_pages(height * width * MOTIONS) + height * width * HOLES


@cache
def _largest(keep: bool) -> Plan:
    return plan_network(keep=keep, fused=False, local=False, together=False)


def rows_within(height: int, width: int, dtype: DTypeLike, limit: int, overlap: int) -> int:
    """The most rows of a strip with which ``bytes_for`` stays within ``limit`` bytes; ``height`` if the whole frame does.

    Args:
        height: of the frame, a multiple of 8.
        width: likewise.
        dtype: of the activations.
        limit: bytes.
        overlap: of ``OVERLAP``.

    Raises:
        DeviceError: not even the smallest strip fits.
    """
    if bytes_for(height, height, width, dtype) <= limit:
        return height
    # The last strip ends with the frame and begins at a multiple of STEP, so all of them have this remainder.
    smallest = 2 * overlap + STEP + height % STEP
    if smallest >= height or bytes_for(smallest, height, width, dtype) > limit:
        smallest_bytes = bytes_for(min(smallest, height), height, width, dtype)
        raise DeviceError(
            f"memory limit: {limit / 2**20:.0f} MiB; frames of {width} x {height} need at least {-(-smallest_bytes // 2**20)} MiB"
        )
    rows = smallest
    while rows + STEP < height and bytes_for(rows + STEP, height, width, dtype) <= limit:
        rows += STEP
    return rows


def strips(height: int, frame_rows: int, rows: int, overlap: int) -> tuple[Strip, ...]:
    """Cover a frame with strips of ``rows`` rows.

    Args:
        height: of the frame, a multiple of 8.
        frame_rows: rows of the frame before it was padded.
        rows: from ``rows_within``.
        overlap: as there.

    Returns:
        Strips in order; every row below ``frame_rows`` is written by exactly one.
    """
    if rows >= height:
        return (Strip(0, 0, frame_rows),)
    parts: list[Strip] = []
    end = top = 0
    while end < frame_rows:
        ends = top + rows >= height
        last = frame_rows if ends else (top + rows - overlap) // STEP * STEP
        parts.append(Strip(top, end - top, last - top))
        end = last
        top = min(end - overlap, height - rows)
    return tuple(parts)
