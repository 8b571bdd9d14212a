# SPDX-License-Identifier: MIT
"""A picture of a wrong answer, drawn and encoded with NumPy alone: the judge is installed without image libraries."""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected

DECADES = 3
"""Decades of error / bound that a picture shows below 1, and at least as many above."""
SIDE, LEAST_WIDTH = 240, 60
"""Approximate length of a panel's longer side, and least width of a panel; pixels on the screen."""
MAX_SIDE = 120
"""Most rows and columns of a frame that a panel shows."""
GAP, PAPER = 8, 33
"""Width of the space between panels, pixels; its grey level, 0 to 255."""


@dataclass(frozen=True)
class Picture:
    """A picture.

    Attributes:
        pixels: (H', W', 3) uint8.
        words: the panels' content, from left to right.
    """

    pixels: NDArray[np.uint8]
    words: str


def draw(got: NDArray[Any], expected: Expected) -> Picture | None:
    """Draw the port's answer, the right answer, and error / bound side by side; of a large frame, the part around its worst pixel.

    Args:
        got: the port's answer: (H, W), (H, W, C), or (N, C, H, W), of which that with the worst pixel is drawn.
        expected: the right answer and its bound.

    Returns:
        The picture; None if the output is no image, or has the wrong shape.
    """
    want = np.asarray(expected.want, np.float64)
    if got.shape == want.shape and want.ndim == 4 and want.size:
        number = int(np.unravel_index(int(expected.ratios(got).argmax()), want.shape)[0])
        return draw(*_one_of_a_batch(got, expected, number))
    if got.shape != want.shape or want.ndim not in (2, 3) or not want.size:
        return None
    ratio = expected.ratios(got)
    worst = np.unravel_index(int(ratio.argmax()), ratio.shape)
    rows, columns = (_window(want.shape[axis], int(worst[axis])) for axis in (0, 1))
    got, want, ratio = (a[rows, columns] for a in (got, want, ratio))
    planes = [a if a.ndim == 3 else a[..., None] for a in (got.astype(np.float64), want)]
    wrong = (ratio if ratio.ndim == 3 else ratio[..., None]).max(axis=-1)
    channel = int(np.argmax(ratio.max(axis=(0, 1)) if ratio.ndim == 3 else np.zeros(1))) if planes[0].shape[-1] != 3 else None
    images = [np.nan_to_num(p if channel is None else np.repeat(p[..., channel : channel + 1], 3, axis=-1)) for p in planes]
    low, high = images[1].min(), images[1].max()
    scaled = [np.clip((p - low) / (high - low if high > low else 1), 0, 1) for p in images]
    with np.errstate(divide="ignore"):
        decades = np.log10(wrong)
    above = max(DECADES, math.ceil(decades[np.isfinite(decades)].max(initial=0)))
    white = np.clip(decades / above, 0, 1)
    heat = np.stack([np.clip(1 + decades / DECADES, 0, 1), white, white], axis=-1)
    zoom = max(1, SIDE // max(want.shape[:2]))
    wide = max(zoom, -(-LEAST_WIDTH // want.shape[1]))
    panels = [np.round(255 * panel).astype(np.uint8).repeat(zoom, axis=0).repeat(wide, axis=1) for panel in (*scaled, heat)]
    gap = np.full((panels[0].shape[0], GAP, 3), PAPER, np.uint8)
    sheet = np.concatenate([gap, *(each for panel in panels for each in (panel, gap))], axis=1)
    words = f"port, expected, error / bound (black 1e-{DECADES}, red 1, white 1e{above})"
    words += "" if channel is None else f", channel {channel}"
    if want.shape != expected.want.shape:
        words += f"; rows {rows.start} to {rows.stop - 1} and columns {columns.start} to {columns.stop - 1} of the frame"
    return Picture(np.pad(sheet, ((GAP, GAP), (0, 0), (0, 0)), constant_values=PAPER), words)


def _one_of_a_batch(got: NDArray[Any], expected: Expected, number: int) -> tuple[NDArray[Any], Expected]:
    allowed = np.broadcast_to(np.asarray(expected.allowed), got.shape)
    one, want, most = (np.moveaxis(a[number], 0, -1) for a in (got, expected.want, allowed))
    return one, Expected(want, most)


def _window(length: int, worst: int) -> slice:
    """The part of an axis that a panel shows: all of a short one, else the part around the worst pixel."""
    start = min(max(worst - MAX_SIDE // 2, 0), max(length - MAX_SIDE, 0))
    return slice(start, min(start + MAX_SIDE, length))


def png(pixels: NDArray[np.uint8]) -> bytes:
    """The bytes of a PNG file of (H, W, 3) pixels, with unfiltered rows in one chunk (W3C, PNG, 2nd edition, 11.2)."""
    height, width, _ = pixels.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
