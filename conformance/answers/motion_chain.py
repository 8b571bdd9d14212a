# SPDX-License-Identifier: MIT
"""Stage motion_chain: the right answers, also where the rounding of a step decides which motion is read."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.port_arithmetic import Arithmetic, reach, sum_error, ways
from conformance.tolerance import BOUNDS
from stss_ref.motion_chain import chain_on, truncated
from stss_ref.sample import Place

MOST_ANSWERS = 32
"""A pixel with more right answers than this is not judged."""
SMALL = 2.0**-62
"""Pixels. Float32 may lose the squares of shorter motions, so that these may count as still, like subnormal ones."""
FLOAT32_MAX = float(np.finfo(np.float32).max)


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
            off = np.where(np.isfinite(chained), off + sum_error(chained, off, arithmetic), 0)
    answers = {(int(y), int(x)): _answers(motions, int(y), int(x), arithmetic) for y, x in np.argwhere(unsure)}
    want, others = chained.copy(), [chained.copy() for _ in range(max((len(a) for a in answers.values()), default=1) - 1)]
    for pixel, pairs in answers.items():
        want[pixel] = pairs[0][0]
        off[pixel] = np.max([wrong for _, wrong in pairs], axis=0)
        for i, other in enumerate(others):
            other[pixel] = pairs[min(i + 1, len(pairs) - 1)][0]
    return {"motion": Expected(want, off + arithmetic.tiny, tuple(others), vectors=True)}


def _is_tied(earlier: NDArray[Any], at: Place, arithmetic: Arithmetic) -> NDArray[np.bool_]:
    """Where rounding may decide: two of the four motions differ but have nearly the same length, or one hardly differs from 0."""
    height, width, _ = earlier.shape
    padded = np.pad(earlier, ((2, 3), (2, 3), (0, 0)))
    x = np.clip(truncated(at.x, at.fx), -2, width + 1) + 2
    y = np.clip(truncated(at.y, at.fy), -2, height + 1) + 2
    four = np.stack([padded[y + j, x + i] for j in (0, 1) for i in (0, 1)])
    lengths = _lengths(four)
    with np.errstate(invalid="ignore"):
        near = (lengths >= _least(lengths.max(axis=0), arithmetic)) | (lengths == lengths.max(axis=0))
    alike = (four == np.take_along_axis(four, lengths.argmax(axis=0)[None, ..., None], axis=0)).all(axis=-1)
    size = np.abs(four).max(axis=-1)
    return (near & ~alike).any(axis=0) | ((size > 0) & (size < max(SMALL, arithmetic.tiny))).any(axis=0)


def _least(longest: Any, arithmetic: Arithmetic) -> Any:
    """The smallest squared length that may count as the longest, of motions whose subnormal components may be 0."""
    return longest * (1 - BOUNDS["length"].roundings * 2.0**-24) - arithmetic.tiny**2


def _lengths(vectors: NDArray[Any]) -> NDArray[np.float64]:
    """Squared lengths with the range of float32: all lengths beyond it are equal."""
    with np.errstate(over="ignore", invalid="ignore"):
        squared = (vectors * vectors).sum(axis=-1)
    return np.where(np.isfinite(vectors).all(axis=-1) & (squared <= FLOAT32_MAX), squared, np.inf)


Answer = tuple[NDArray[np.float64], NDArray[np.float64]]
"""A chained motion, and its largest error; pixels."""


def _answers(motions: NDArray[Any], y: int, x: int, arithmetic: Arithmetic) -> list[Answer]:
    """All right answers of pixel (y, x)."""
    ends: list[Answer] = [(motions[0, y, x], np.zeros(2))]
    for earlier in motions[1:]:
        further: dict[bytes, Answer] = {}
        for chained, off in ends:
            for step in _steps(earlier, (x, y), chained, off, arithmetic):
                with np.errstate(invalid="ignore"):
                    total = chained + step
                    wrong = np.where(np.isfinite(total), off + sum_error(total, off, arithmetic), 0)
                further[total.tobytes()] = (total, wrong)
        ends = list(further.values())[:MOST_ANSWERS]
    return ends


def _steps(
    earlier: NDArray[Any], pixel: tuple[int, int], chained: NDArray[Any], off: NDArray[Any], arithmetic: Arithmetic
) -> list[NDArray[np.float64]]:
    """The motions that one step may read."""
    if not np.isfinite(chained).all():
        return [np.zeros(2)]
    wrong = off + np.where(chained == 0, 0, arithmetic.flushed(chained))
    columns, rows = (
        {_trunc(*way) for way in ways(p + math.floor(m), m - math.floor(m), e)}
        for p, m, e in zip(pixel, map(float, chained), map(float, wrong), strict=True)
    )
    return [step for row in sorted(rows) for column in sorted(columns) for step in _longest(earlier, row, column, arithmetic)]


def _trunc(whole: int, fraction: float) -> int:
    return 0 if whole == -1 and fraction > 0 else whole


def _longest(earlier: NDArray[Any], row: int, column: int, arithmetic: Arithmetic) -> list[NDArray[np.float64]]:
    """The motions, of the four at a corner, that may count as the longest."""
    height, width, _ = earlier.shape
    places = [(row + j, column + i) for j in (0, 1) for i in (0, 1)]
    four = np.array([earlier[p] if 0 <= p[0] < height and 0 <= p[1] < width else (0.0, 0.0) for p in places])
    size = np.abs(four).max(axis=-1)
    if (size == 0).any():
        return [np.zeros(2)]
    lengths = _lengths(four)
    first = int(lengths.argmax())
    candidates = [four[first]]
    for i in range(4):
        alike = (np.abs(four[i]) == np.abs(four[first])).all() or lengths[i] == np.inf == lengths[first]
        if (
            not alike
            and lengths[i] >= _least(lengths[first], arithmetic)
            and not _surely_shorter(four, lengths, i, first, arithmetic)
        ):
            candidates.append(four[i])
    return [*candidates, np.zeros(2)] if (size < max(SMALL, arithmetic.tiny)).any() else candidates


def _surely_shorter(four: NDArray[Any], lengths: NDArray[Any], i: int, first: int, arithmetic: Arithmetic) -> bool:
    """Whether motion ``i`` cannot be the longest: it is shorter than ``first``, or as long and later; float32 has the squares exactly."""
    squares = four[[i, first]] ** 2
    if ((squares > 0) & (squares < arithmetic.tiny**2)).any():
        return False
    exact = Arithmetic("float32").holds(squares).all() and Arithmetic("float32").holds(lengths[[i, first]]).all()
    return bool(exact) and (lengths[i] < lengths[first] or i > first)
