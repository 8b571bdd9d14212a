# SPDX-License-Identifier: MIT
"""Stage occlusion_warp: the motions that a port may splat to each pixel, and the colours that it then reads."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.port_arithmetic import Arithmetic, Reach, may_lead, reach
from conformance.answers.warp import interpolate
from stss_ref.occlusion_warp import FARTHEST, look_up, splat, writing_order
from stss_ref.sample import Index

Size = tuple[int, ...]
Pairs = tuple[Index, Index]
NOBODY = -1
"""The writer of a pixel to which no motion leads."""


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
    """Motions looked up in the splatted map: the truth first, then further right answers where rounding decides.

    Pixels go by their number in raster order, those that write also by their number in the order of writing: the largest wins.
    """
    if not at.unsure.any():
        return [look_up(splat(motion, depth), motion)]
    size, place = depth.shape, at.at
    order = writing_order(depth, place.finite & (depth < FARTHEST))
    rows, _ = may_lead(place.y.ravel(), place.fy.ravel(), at.off_y.ravel(), size[0])
    columns, _ = may_lead(place.x.ravel(), place.fx.ravel(), at.off_x.ravel(), size[1])
    right = _winners(rows[1:2, order], columns[1:2, order], size)[_read(rows[1:2], columns[1:2], size)]
    reader, writer = _right_pairs(rows, columns, at.unsure.ravel(), order, size)
    is_other = writer != right[reader]
    reader, writer = reader[is_other], writer[is_other]
    number = np.arange(len(reader)) - np.searchsorted(reader, reader)
    answers = [right, *(right.copy() for _ in range(max(number, default=-1) + 1))]
    for i, answer in enumerate(answers[1:]):
        answer[reader[number == i]] = writer[number == i]
    motions = np.concatenate([motion.reshape(-1, 2)[order], np.zeros((1, 2))])  # the last one: nobody's
    return [motions[answer].reshape(motion.shape) for answer in answers]


def _right_pairs(rows: Index, columns: Index, unsure: NDArray[np.bool_], order: Index, size: Size) -> Pairs:
    """Each pixel that reads, (K,) in order, and a pixel whose motion it may read, by its number in the order of writing.

    Args:
        rows, columns: (3, N) where the motion of each pixel may lead, its own place in the middle.
        unsure: (N,) where that is more than one place.
        order: (M,) the pixels that write.
        size: (H, W).
    """
    sure = _winners(rows[:, order], columns[:, order], size)
    writer = np.flatnonzero(unsure[order])
    y, x = (np.concatenate([each, each + 1])[:, order[writer]] for each in (rows, columns))
    written, writer = _written(y, x, writer, size)
    may_win = writer > sure[written]
    written, writer = written[may_win], writer[may_win]
    by_pixel = np.argsort(written)
    written, writer = written[by_pixel], writer[by_pixel]

    own, other = _read(rows[1:2], columns[1:2], size), _read(rows[:, unsure], columns[:, unsure], size)
    reader = np.concatenate([np.arange(len(own)), np.tile(np.flatnonzero(unsure), len(rows) * len(columns))])
    read = np.concatenate([own, other])
    first = np.searchsorted(written, read)
    count = np.searchsorted(written, read, "right") - first
    which = np.arange(count.sum()) + np.repeat(first - np.cumsum(count) + count, count)
    readers, writers = np.concatenate([reader, np.repeat(reader, count)]), np.concatenate([sure[read], writer[which]])
    reader, writer = np.divmod(np.unique(readers * (len(order) + 1) + writers - NOBODY), len(order) + 1)
    return reader, writer + NOBODY


def _winners(rows: Index, columns: Index, size: Size) -> Index:
    """(H W,) the last writer of each pixel, of those that write there by every way; of (ways, M) in the order of writing."""
    # The pixels of all ways begin at the last way's first and end at the first way's second.
    rows, columns = (np.stack([each.max(axis=0), each.min(axis=0) + 1]) for each in (rows, columns))
    always = (rows[0] <= rows[1]) & (columns[0] <= columns[1])
    written, writer = _written(rows[:, always], columns[:, always], np.flatnonzero(always), size)
    winners = np.full(size, NOBODY).ravel()
    np.maximum.at(winners, written, writer)
    return winners


def _written(rows: Index, columns: Index, writer: Index, size: Size) -> Pairs:
    """The pixels in all of the rows and columns, each (n, M), as far as they lie in the frame, each with its ``writer`` (M,)."""
    lands = ((rows >= 0) & (rows < size[0]))[:, None] & (columns >= 0) & (columns < size[1])
    return (rows[:, None] * size[1] + columns)[lands], np.broadcast_to(writer, lands.shape)[lands]


def _read(rows: Index, columns: Index, size: Size) -> Index:
    """The pixels in all of the rows and columns, each (n, N), clamped into the frame, row by row: (n n N,)."""
    return (np.clip(rows, 0, size[0] - 1)[:, None] * size[1] + np.clip(columns, 0, size[1] - 1)).ravel()
