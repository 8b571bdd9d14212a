# SPDX-License-Identifier: MIT
"""Stage motion_chain: the right answers, also where the rounding of a step decides which motion is read."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.port_arithmetic import Arithmetic, may_lead, reach, sum_error
from conformance.tolerance import BOUNDS
from stss_ref.motion_chain import chain_on, is_any_still, read_motion, squared_lengths, truncated
from stss_ref.sample import Index, Place

MOST_ANSWERS = 32
"""A pixel with more right answers is vague: it is not judged."""
SMALL = 2.0**-62
"""Pixels. Float32 may lose the squares of shorter motions, so that these may count as still, like subnormal ones."""
FLOAT32_MAX = float(np.finfo(np.float32).max)
Float64 = NDArray[Any]
Bool = NDArray[np.bool_]


class Ways(NamedTuple):
    """All ways of the chains of some pixels, those of a pixel one after the other.

    Attributes:
        pixel: (N,) number of the pixel.
        chained: (N, 2) the motion so far; pixels.
        off: (N, 2) its largest error; pixels.
    """

    pixel: Index
    chained: Float64
    off: Float64

    def take(self, which: NDArray[Any]) -> Ways:
        """The ways of these numbers, or of this mask."""
        return Ways(*(array[which] for array in self))


def expect_motion_chain(inputs: dict[str, NDArray[Any]], arithmetic: Arithmetic) -> dict[str, Expected]:
    """The chain in float64, and further right answers where a step is within rounding of a pixel's edge or of a tie.

    Args:
        inputs: of the stage, float64.
        arithmetic: of the port.
    """
    motions = inputs["motions"]
    chained: NDArray[Any] = motions[0]
    off: NDArray[Any] = np.zeros_like(chained)
    unsure = np.zeros(chained.shape[:2], bool)
    for earlier in motions[1:]:
        at = reach(chained, arithmetic, off)
        unsure |= at.at.finite & (at.unsure | _is_tied(earlier, at.at, arithmetic))
        with np.errstate(invalid="ignore"):
            chained = chain_on(chained, earlier)
        off = _sum_off(chained, off, arithmetic)
    y, x = np.nonzero(unsure)
    ways, vague = _follow(motions, x, y, arithmetic)
    _, first, count = np.unique(ways.pixel, return_index=True, return_counts=True)
    off[y, x] = np.maximum.reduceat(ways.off, first)
    answers = [chained.copy() for _ in range(max(count, default=1))]
    for i, answer in enumerate(answers):
        answer[y, x] = ways.chained[first + np.minimum(i, count - 1)]
    if vague.any():
        answers.append(chained.copy())
        for answer in answers:
            answer[y[vague], x[vague]] = 0
        # Any number is right, and so is none.
        off[y[vague], x[vague]], answers[-1][y[vague], x[vague]] = np.inf, np.nan
    return {"motion": Expected(answers[0], off + arithmetic.tiny, tuple(answers[1:]), vectors=True)}


def _sum_off(total: Float64, off: Float64, arithmetic: Arithmetic) -> Float64:
    """The largest error of a chain after a sum; a chain that is not finite has none."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(total), off + sum_error(total, off, arithmetic), 0)


def _is_tied(earlier: NDArray[Any], at: Place, arithmetic: Arithmetic) -> Bool:
    """Where rounding may decide which of the four motions counts as the longest."""
    _, may_count = _longest(earlier, truncated(at.x, at.fx), truncated(at.y, at.fy), arithmetic)
    return may_count.sum(axis=0) > 1


def _follow(motions: NDArray[Any], x: Index, y: Index, arithmetic: Arithmetic) -> tuple[Ways, Bool]:
    """All ways of the chains of pixels (x, y), both (P,), and which pixels are vague: of these one way is followed."""
    ways, vague = Ways(np.arange(len(x)), motions[0, y, x], np.zeros((len(x), 2))), np.zeros(len(x), bool)
    for earlier in motions[1:]:
        ways, is_far = _step(earlier, x[ways.pixel], y[ways.pixel], ways, arithmetic)
        ways = _different(ways)
        number = np.arange(len(ways.pixel)) - np.searchsorted(ways.pixel, ways.pixel)
        vague[is_far] = vague[ways.pixel[number >= MOST_ANSWERS]] = True
        ways = ways.take((number == 0) | ~vague[ways.pixel])
    return ways, vague


def _different(ways: Ways) -> Ways:
    """The first way to each motion, with the largest error of all to it."""
    keys = (*ways.chained.view(np.int64).T, ways.pixel)
    order = np.lexsort(keys)
    is_new = np.ones(len(order), bool)
    is_new[1:] = np.any([key[order][1:] != key[order][:-1] for key in keys], axis=0)
    first = order[is_new]
    off = np.maximum.reduceat(ways.off[order], np.flatnonzero(is_new))
    return Ways(ways.pixel[first], ways.chained[first], off).take(first.argsort())


def _step(earlier: NDArray[Any], x: Index, y: Index, ways: Ways, arithmetic: Arithmetic) -> tuple[Ways, Index]:
    """The ways (N), of pixels (x, y), both (N,), after one more step, and the pixels of those whose place is off by more than a pixel."""
    finite = _both(np.isfinite(ways.chained))
    x, y = np.where(finite, (x, y), -2)  # outside the frame, where all motion is 0
    chained = np.where(finite[:, None], ways.chained, 0)
    off = ways.off + np.where(chained == 0, 0, arithmetic.flushed(chained))
    height, width, _ = earlier.shape
    columns, other_column = _cells(x, chained[:, 0], off[:, 0], width)
    rows, other_row = _cells(y, chained[:, 1], off[:, 1], height)
    is_far = (np.ptp(columns, axis=0) > 2) | (np.ptp(rows, axis=0) > 2)
    way, row, column = np.nonzero((other_row[:, None] & other_column).transpose(2, 0, 1))
    motions, may_count = _longest(earlier, columns[column, way], rows[row, way], arithmetic)
    corner, which = np.nonzero(may_count.T)
    pixel, chained, off = ways.take(way[corner])
    with np.errstate(invalid="ignore"):
        chained = chained + motions[which, corner]
    return Ways(pixel, chained, _sum_off(chained, off, arithmetic)), ways.pixel[is_far]


def _cells(pixel: Index, motion: Float64, off: Float64, size: int) -> tuple[Index, Bool]:
    """The cells (3, N) along an axis where motion that is off by up to ``off`` may lead, in order, and where one differs from the last."""
    whole = np.floor(motion)
    cells = truncated(*may_lead(pixel + whole, motion - whole, off, size))
    return cells, np.diff(cells, axis=0, prepend=-3) > 0


def _longest(earlier: NDArray[Any], column: Index, row: Index, arithmetic: Arithmetic) -> tuple[Float64, Bool]:
    """Six motions of a corner: the longest of the four there, all four, and 0; and which of them may count as the longest.

    Args:
        earlier: (H, W, 2) motion.
        column, row: of the corners, any shape S.
        arithmetic: of the port.

    Returns:
        motions: (6, S, 2).
        may_count: (6, S); of motions as long as the longest but for the sign of a component, the longest alone.
    """
    four = np.stack([read_motion(earlier, column + i, row + j) for j in (0, 1) for i in (0, 1)])
    squares = squared_lengths(four)
    squares = np.where(squares <= FLOAT32_MAX, squares, np.inf)  # all lengths beyond float32's range may be equal
    first = squares.argmax(axis=0)[None]
    longest = np.take_along_axis(four, first[..., None], axis=0)
    most, is_exact = np.take_along_axis(squares, first, axis=0), _is_exact(four, squares, arithmetic)
    sure = is_exact & np.take_along_axis(is_exact, first, axis=0)
    alike = _both(np.abs(four) == np.abs(longest)) | ~(_both(np.isfinite(four)) | _both(np.isfinite(longest)))
    # Subnormal components may be 0.
    near = squares >= most * (1 - BOUNDS["length"].roundings * 2.0**-24) - arithmetic.tiny**2
    still = is_any_still(four)[None]
    small = _both(np.abs(four) < max(SMALL, arithmetic.tiny)).any(axis=0, keepdims=True)
    may_count = np.concatenate([~still, ~still & near & ~alike & ~sure, small])
    return np.concatenate([longest, four, np.zeros_like(longest)]), may_count


def _is_exact(motions: NDArray[Any], squared: Float64, arithmetic: Arithmetic) -> Bool:
    """Where float32 has the squares of both components, and their sum, exactly."""
    with np.errstate(over="ignore"):
        squares = motions * motions
    lost = (squares > 0) & (squares < arithmetic.tiny**2)
    holds = Arithmetic("float32").holds
    return _both(holds(squares) & ~lost) & holds(squared)


def _both(components: Bool) -> Bool:
    """Where it is true of both components; the last axis."""
    return components[..., 0] & components[..., 1]
