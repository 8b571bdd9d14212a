# SPDX-License-Identifier: MIT
"""Stage occlusion_warp: the motions that a port may splat to each pixel, and the colours that it then reads."""

from __future__ import annotations

from collections import defaultdict
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.port_arithmetic import Arithmetic, Reach, reach, ways
from conformance.answers.warp import interpolate
from stss_ref.occlusion_warp import FARTHEST, splat
from stss_ref.sample import taps

Cell = tuple[int, int]
Key = tuple[float, int]
NOBODY: Key = (np.inf, -1)


def expect_occlusion_warp(
    inputs: dict[str, NDArray[Any]],
    arithmetic: Arithmetic,
    got: dict[str, NDArray[Any]] | None = None,
    off: NDArray[np.float64] | float = 0.0,
) -> dict[str, Expected]:
    """The motion looked up in the splatted map, a copy, and the colour that the port's own motion reads.

    Args:
        inputs: of the stage, float64.
        arithmetic: of the port.
        got: the port's outputs; None: the right motion reads the colour.
        off: (H, W, 2) largest error of the port's input motion; pixels.
    """
    motion = inputs["motion"]
    at = reach(motion, arithmetic, off)
    maps = _maps(at, motion, inputs["depth"])
    flush = np.max([arithmetic.flushed(each) for each in maps], axis=0)
    expected = Expected(maps[0], flush, tuple(maps[1:]), vectors=True)
    by = (got["occlusion_motion"] if got else maps[0]).astype(np.float64)
    valid = inputs["valid"].astype(bool)[..., None]
    instead, allowed = interpolate(inputs["color"], reach(by, arithmetic), arithmetic)
    warped = Expected(np.where(valid, inputs["warped"], instead), np.where(valid, arithmetic.flushed(inputs["warped"]), allowed))
    return {"occlusion_motion": expected, "occlusion_warp": warped}


def _maps(at: Reach, motion: NDArray[Any], depth: NDArray[Any]) -> list[NDArray[Any]]:
    """Motions looked up in the splatted map: the truth first, then further right answers where rounding decides."""
    if not (at.off_x.any() or at.off_y.any()):
        cell = taps(at.at)
        return [splat(motion, depth)[cell.y0, cell.x0]]
    definite, maybe = _splats(at, depth)
    answers = _look_up(at, motion, definite, maybe)
    most = max(len(motions) for motions in answers.values())
    maps = [np.empty_like(motion) for _ in range(most)]
    for pixel, motions in answers.items():
        for i, each in enumerate(maps):
            each[pixel] = motions[min(i, len(motions) - 1)]
    return maps


def _cells(reached: Reach, y: int, x: int) -> tuple[set[int], set[int]]:
    """The rows and the columns of pixels that the motion of pixel (y, x) may lead to."""
    at = reached.at
    columns = ways(int(at.x[y, x]), float(at.fx[y, x]), float(reached.off_x[y, x]))
    rows = ways(int(at.y[y, x]), float(at.fy[y, x]), float(reached.off_y[y, x]))
    return {row for row, _ in rows}, {column for column, _ in columns}


def _splats(at: Reach, depth: NDArray[Any]) -> tuple[dict[Cell, Key], dict[Cell, list[Key]]]:
    """For each pixel of the earlier frame: the nearest pixel that certainly writes there, and all pixels that may write there."""
    height, width = depth.shape
    definite: dict[Cell, Key] = defaultdict(lambda: NOBODY)
    maybe: dict[Cell, list[Key]] = defaultdict(list)
    for index, (y, x) in enumerate(np.ndindex(height, width)):
        if not at.at.finite[y, x] or not depth[y, x] < FARTHEST:
            continue
        rows, columns = _cells(at, y, x)
        key = (float(depth[y, x]), index)
        cells = [{(r + j, c + i) for j in (0, 1) for i in (0, 1)} for r, c in product(rows, columns)]
        for cell in set[Cell].union(*cells):
            if not (0 <= cell[0] < height and 0 <= cell[1] < width):
                continue
            if all(cell in way for way in cells):
                definite[cell] = min(definite[cell], key, key=_order)
            else:
                maybe[cell].append(key)
    return definite, maybe


def _order(key: Key) -> Key:
    """Sort key: the nearest first, with 0 and -0 as the same depth."""
    return key[0] + 0.0, key[1] if key[1] >= 0 else 2**62


def _look_up(
    at: Reach, motion: NDArray[Any], definite: dict[Cell, Key], maybe: dict[Cell, list[Key]]
) -> dict[Cell, list[NDArray[np.float64]]]:
    height, width, _ = motion.shape
    flat = np.concatenate([motion.reshape(-1, 2), np.zeros((1, 2))])  # the last row: no pixel wrote
    answers: dict[Cell, list[NDArray[np.float64]]] = {}
    for y, x in np.ndindex(height, width):
        rows, columns = _cells(at, y, x)
        sources: dict[int, None] = {}
        for r, c in product(sorted(rows), sorted(columns)):
            cell = min(max(r, 0), height - 1), min(max(c, 0), width - 1)
            best = definite[cell]
            for key in (best, *(k for k in maybe.get(cell, ()) if _order(k) < _order(best))):
                sources[key[1]] = None
        answers[y, x] = [flat[index] for index in sources]
    return answers
