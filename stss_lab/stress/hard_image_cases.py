# SPDX-License-Identifier: MIT
"""Inputs made to lose digits in the image-space stages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stss.images.color import transfer
from stss_lab.stress.inputs import REACH
from stss_lab.stress.table import Cell, StressPlan, StressTable, short
from stss_ref.arrays import Array, Image, Mask
from stss_ref.holes import HoleLimits, holes
from stss_ref.sample import Taps, follow, taps
from stss_ref.warp import warp

DISTANCES = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8)
"""Distances of the scene from the origin; cm."""
FOOTPRINT = 5.0
"""Distance of neighbouring pixels' positions; cm."""
SCENE = 1000.0
"""Extent of the scene; cm."""
PIXELS = 20000
WIDTHS = (240, 480, 960, 1920, 3840, 7680)
NEAR_WHOLE = 1e-4
"""Distance from whole pixels of the motions that are nearly whole; pixels."""


def positions(plan: StressPlan) -> StressTable:
    """The hole test far from the origin: offsets within 10 % of the limit of a pixel that covers 5 cm."""
    limit = HoleLimits().footprints * FOOTPRINT
    rows: list[tuple[Cell, ...]] = []
    for far in DISTANCES:
        shares: list[tuple[float, ...]] = []
        for seed in range(plan.seeds):
            here, there, origin = _pairs(seed, far, limit)
            truth = np.sqrt(((there - here) ** 2).sum(axis=-1))[0] <= limit
            single, half = _stored(here, there, "float32"), _stored(here, there, "float16")
            ways = (
                _trusted(*single, "float32"),
                _trusted(*single, "float64"),
                _trusted(here - origin, there - origin, "float32"),
                _trusted(*half, "float32"),
            )
            shares.append(tuple(100 * float((way != truth).mean()) for way in ways))
        step = float(np.spacing(np.float32(far)))
        rows.append((short(far), step, *(float(x) for x in np.max(shares, axis=0))))
    columns = (
        "cm from the origin", "step of float32, cm", "float32", "its test in float64",
        "origin taken off by the renderer", "half",
    )  # fmt: skip
    return StressTable(
        "positions", "Wrong verdicts in per cent, of offsets within 10 % of 1.5 footprints, 7.5 cm", columns, tuple(rows)
    )


def _pairs(seed: int, far: float, limit: float) -> tuple[Array, Array, Array]:
    """Positions now and before, (2, N, 3) cm in float64, and the scene's origin. The second row lies a footprint from the first."""
    random = np.random.default_rng(seed)

    def directions(*shape: int) -> Array:
        d = random.standard_normal((*shape, 3))
        return d / np.sqrt((d * d).sum(axis=-1, keepdims=True))

    origin = far * directions()
    here = origin + random.uniform(-1, 1, (PIXELS, 3)) * min(SCENE, far)
    rows = np.array(((0, 0, 0), (FOOTPRINT, 0, 0)))[:, None]
    return here + rows, here + rows + directions(PIXELS) * limit * random.uniform(0.9, 1.1, (PIXELS, 1)), origin


def _stored(here: Array, there: Array, dtype: str) -> tuple[Array, Array]:
    """Both as a file of this dtype stores them; a number too large for half becomes NaN."""
    with np.errstate(over="ignore"):
        rounded = [p.astype(dtype).astype(np.float64) for p in (here, there)]
    return np.where(np.isfinite(rounded[0]), rounded[0], np.nan), np.where(np.isfinite(rounded[1]), rounded[1], np.nan)


def _trusted(here: Array, there: Array, dtype: str) -> Mask:
    """The verdict of stage ``holes`` on each pair, without motion."""
    # Each pair is two pixels wide: all taps in the row of its first pixel are then the same, and its neighbour at no distance.
    here, there = (np.repeat(p.astype(dtype), 2, axis=1) for p in (here, there))
    zero, normal = np.zeros(here.shape[:2], dtype), np.ones_like(here)
    return holes(np.zeros((*here.shape[:2], 2), dtype), zero, zero, normal, normal, there, here, zero, zero)[0, ::2]


def motion(plan: StressPlan) -> StressTable:
    """Positions in wide frames: a sum ``p + m`` loses digits of the fraction between two pixels; kept apart, nothing is lost."""
    rows: list[tuple[Cell, ...]] = []
    for width in WIDTHS:
        found = np.array([_motion_errors(seed, width) for seed in range(plan.seeds)])
        rows.append((f"{width}", float(np.spacing(np.float32(width - 1))), *(float(x) for x in found.max(axis=0))))
    columns = (
        "width",
        "step of a position, px",
        "colour, p + m",
        "colour, apart",
        "wrong taps in %, p + m",
        "wrong taps in %, apart",
    )
    title = f"Warped noise in [0, 1], motion up to {REACH:g} px: largest error; taps where within {short(NEAR_WHOLE)} px of whole pixels"
    return StressTable("motion", title, columns, tuple(rows))


def _motion_errors(seed: int, width: int) -> tuple[float, float, float, float]:
    random = np.random.default_rng(seed)
    color = random.random((8, width, 1)).astype(np.float32)
    moved = random.uniform(-REACH, REACH, (8, width, 2)).astype(np.float32)
    truth = warp(color.astype(np.float64), moved.astype(np.float64))[0]
    errors = [float(np.abs(warp(color, m)[0] - truth).max()) for m in (rounded_sum(moved), moved)]
    whole = (np.rint(moved) + random.uniform(-NEAR_WHOLE, NEAR_WHOLE, moved.shape)).astype(np.float32)
    right = taps(follow(whole.astype(np.float64)))
    flips = [100 * float((_first(taps(follow(m))) != _first(right)).mean()) for m in (rounded_sum(whole), whole)]
    return errors[0], errors[1], flips[0], flips[1]


def _first(at: Taps) -> NDArray[np.intp]:
    """The raster index of the upper left of the four taps."""
    return at.y0 * at.x0.shape[1] + at.x0


def rounded_sum(motion: Image) -> Image:
    """The motion that remains where the sum ``p + motion(p)`` is rounded, as it was before specification version 2."""
    y, x = np.indices(motion.shape[:2])
    p = np.stack([x, y], axis=-1).astype(motion.dtype)
    return (p + motion) - p


def tone(_: StressPlan) -> StressTable:
    """Transfer ``hdr`` near its pole: how an error of the encoded colour grows in scene-linear light."""
    hdr = transfer("hdr")
    rows: list[tuple[Cell, ...]] = []
    for value in (0.01, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4):
        color = np.full((1, 1, 3), value, np.float32)
        encoded = hdr.encode(color).astype(np.float64)
        losses = [abs(float(hdr.decode((encoded - by).astype(np.float32))[0, 0, 0]) / value - 1) for by in (0.0, 1e-6, 1e-3)]
        upwards = float(hdr.decode((encoded + 1e-3).astype(np.float32))[0, 0, 0])
        rows.append((short(value), float(1 - encoded.max()), *losses, upwards))
    columns = (
        "light", "1 - encoded", "there and back", "encoded - 1e-6", "encoded - 1e-3", "light of encoded + 1e-3",
    )  # fmt: skip
    return StressTable("tone", "Relative error of the light", columns, tuple(rows))
