# SPDX-License-Identifier: MIT
"""The hole test far from the origin."""

from __future__ import annotations

import numpy as np

from stss_lab.stress.table import Cell, StressPlan, StressTable, short
from stss_ref.arrays import Array, Mask
from stss_ref.constants import HoleLimits
from stss_ref.holes import holes

DISTANCES = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8)
"""Distances of the scene from the origin; cm."""
FOOTPRINT = 5.0
"""Distance of neighbouring pixels' positions; cm."""
SCENE = 1000.0
"""Extent of the scene; cm."""
PIXELS = 20000


def positions(plan: StressPlan) -> StressTable:
    """The hole test far from the origin: offsets within 10 % of the limit of a pixel that covers 5 cm."""
    limit = HoleLimits().footprints * FOOTPRINT
    rows: list[tuple[Cell, ...]] = []
    for far in DISTANCES:
        shares: list[tuple[float, ...]] = []
        for seed in range(plan.seeds):
            here, there, origin = _pairs(seed, far, limit)
            truth = np.sqrt(((there - here) ** 2).sum(axis=-1))[0] <= limit
            single, half = _store(here, there, "float32"), _store(here, there, "float16")
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


def _store(here: Array, there: Array, dtype: str) -> tuple[Array, Array]:
    """Both arrays as a file of this dtype stores them; a number too large for half becomes NaN."""
    with np.errstate(over="ignore"):
        rounded = [p.astype(dtype).astype(np.float64) for p in (here, there)]
    return np.where(np.isfinite(rounded[0]), rounded[0], np.nan), np.where(np.isfinite(rounded[1]), rounded[1], np.nan)


def _trusted(here: Array, there: Array, dtype: str) -> Mask:
    """The verdict of stage ``holes`` on each pair, without motion."""
    # Each pair is two pixels wide: all taps in the row of its first pixel are then the same, and its neighbour at no distance.
    here, there = (np.repeat(p.astype(dtype), 2, axis=1) for p in (here, there))
    zero, normal = np.zeros(here.shape[:2], dtype), np.ones_like(here)
    return holes(np.zeros((*here.shape[:2], 2), dtype), zero, zero, normal, normal, there, here, zero, zero)[0, ::2]
