# SPDX-License-Identifier: MIT
"""Stage reshade: whether each sample shows a hole's own surface, and the errors of means of samples and of like materials."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.holes import SMALL, Bool, Float64, Maybe, reach_of_footprints
from conformance.answers.port_arithmetic import Arithmetic, Reach, reach
from conformance.tolerance import BOUNDS
from stss_ref.holes import squared
from stss_ref.reshade import (
    COSINE,
    FLOOR,
    FOOTPRINTS,
    REACH,
    STATIC_COSINE,
    STEPS,
    UNMIXED,
    brightness,
    four_samples,
    is_background,
    is_mixed,
    reshade,
    ring_rows,
    square_rows,
)
from stss_ref.sample import Index

Pixels = tuple[Index, Index]


def expect_reshade(
    inputs: dict[str, NDArray[Any]], arithmetic: Arithmetic, off: Float64 | float = 0.0
) -> tuple[dict[str, Expected], Bool]:
    """The float64 reference's colours, and (H, W) where a deciding comparison is within rounding of its threshold.

    There any mean of the two colours is right.

    Args:
        inputs: of the stage, float64.
        arithmetic: of the port.
        off: (H, W, 2) largest error of the port's motion; pixels.
    """
    want = reshade(**inputs)
    color, warped = np.maximum(inputs["color"], 0), np.maximum(inputs["warped"], 0)
    undecided, has, is_source = (np.zeros(want.shape[:2], bool) for _ in range(3))
    is_source |= inputs["valid"] != 0
    holes = _pixels(~is_source)
    sure, unsure, peak = _own(inputs, color, holes, reach(inputs["motion"], arithmetic, off), arithmetic)
    has[holes], undecided[holes] = sure, unsure
    of_source = np.where(is_source, warped.max(axis=-1), 0)
    of_source[holes] = peak
    is_source |= has
    # A hole that has no sample, or is a moving object's, depends on those around it, too.
    alone = _pixels(~is_source | (has & (inputs["stencil"] != 0)))
    terms, light, doubts = _around(inputs, is_source, of_source, undecided, alone, arithmetic)
    undecided[alone] |= doubts
    looks = terms > 0
    alone = alone[0][looks], alone[1][looks]
    terms, light, doubts = _shared(inputs, terms[looks], light[looks], undecided, alone)
    undecided[alone] |= doubts
    roundings = np.where(has, BOUNDS["own"].roundings, 0.0)
    scale = np.where(has, of_source, 0.0)
    roundings[alone] = sum(BOUNDS[name].roundings for name in ("like", "own", "share")) + 2 * terms
    y, x = alone
    scale[alone] = (brightness(inputs["base_color"][y, x], is_mixed(inputs["normal"][y, x])) * light).max(axis=-1)
    allowed = roundings * (arithmetic.unit * scale + arithmetic.tiny)
    # The light of any sources gives no more than the brightest surface in that of the darkest, but for the roundings of the longest sum.
    largest = max(color.max(), warped.max()) * np.sqrt(1 + 1 / FLOOR)
    most = BOUNDS["like"].roundings + BOUNDS["share"].roundings + 2 * len(STEPS) * 8 * REACH
    allowed = np.where(undecided, largest * (1 + most * arithmetic.unit), allowed)[..., None] + arithmetic.flushed(warped)
    return {"reshade": Expected(want, allowed, free=undecided[..., None])}, undecided


def _pixels(where: Bool) -> Pixels:
    y, x = np.nonzero(where)
    return y, x


def _own(
    inputs: dict[str, NDArray[Any]], color: NDArray[Any], holes: Pixels, at: Reach, arithmetic: Arithmetic
) -> tuple[Bool, Bool, Float64]:
    """For each hole, (N,): whether it has samples of its own, whether a comparison may change, and the largest colour among the samples."""
    has, unsure, peak = np.zeros(len(holes[0]), bool), at.unsure[holes], np.zeros(len(holes[0]))
    for there, *sample in four_samples(inputs["motion"], *holes):
        row, column = sample
        shows = _shows(inputs, (row, column), holes, arithmetic)
        has |= there & shows.sure
        unsure |= there & shows.possible & ~shows.sure
        peak = np.maximum(peak, np.where(there & shows.possible, color[row, column].max(axis=-1), 0))
    return has, unsure, peak


def _shows(inputs: dict[str, NDArray[Any]], sample: Pixels, pixel: Pixels, arithmetic: Arithmetic) -> Maybe:
    """Whether samples show the surface of pixels."""
    unit, stencil = arithmetic.unit, inputs["stencil"][pixel]
    normal, n = inputs["normal"][pixel], inputs["normal_previous"][sample]
    size = np.maximum(np.abs(normal), np.abs(n)).max(axis=-1)
    none = Maybe(size == 0, size < arithmetic.tiny)
    dot = (normal * n).sum(axis=-1)
    least = np.where(stencil == 0, STATIC_COSINE, COSINE)
    wrong = BOUNDS["dot"].roundings * unit * np.abs(normal * n).sum(axis=-1) + unit * least + arithmetic.tiny
    alike = Maybe(dot - wrong >= least, dot + wrong >= least)
    with np.errstate(invalid="ignore", over="ignore"):
        apart = inputs["position_previous"][sample] - inputs["position"][pixel]
        distance = np.sqrt((apart * apart).sum(axis=-1))
        limit, limit_off, large = (plane[pixel] for plane in reach_of_footprints(inputs["position"], FOOTPRINTS, unit))
        off = BOUNDS["length"].roundings * unit * distance + np.where(distance > 0, SMALL, 0)
        large |= np.isfinite(distance) & (distance > 1 / SMALL)
        # A value that is not finite is near no other: infinity minus infinity compares as false.
        near = Maybe((distance + off <= np.maximum(limit - limit_off, 0)) & ~large, (distance - off <= limit + limit_off) | large)
    surface = none | (alike & (Maybe(stencil != 0, stencil != 0) | near))
    same = inputs["stencil_previous"][sample] == stencil
    return surface & Maybe(same, same)


def _around(
    inputs: dict[str, NDArray[Any]], is_source: Bool, peaks: Float64, undecided: Bool, pixels: Pixels, arithmetic: Arithmetic
) -> tuple[Float64, Float64, Bool]:
    """Of each pixel, the number of sources around it, (N,), the largest of their lights, (N, 3), and whether it is undecided, (N,).

    It is if a source is, or if a port may take a normal for 0, or its own for a mixed one.
    """
    stencil, normal, base_color = inputs["stencil"], inputs["normal"], inputs["base_color"]
    background = is_background(normal)
    hardly = ~background & (np.abs(normal).max(axis=-1) < arithmetic.tiny)
    y, x = pixels
    mixed, length = is_mixed(normal[y, x]), squared(normal[y, x])
    doubts = np.abs(length - UNMIXED) <= BOUNDS["dot"].roundings * arithmetic.unit * length
    count, peak = np.zeros(len(y)), np.zeros((len(y), 3))
    for there, at in ring_rows(stencil.shape, y, x):
        counts = there & (stencil[at] == stencil[y, x])
        sources = counts & is_source[at] & (background[at] == background[y, x])
        count += sources.sum(axis=0)
        peak = np.maximum(
            peak, np.where(sources[..., None], peaks[at][..., None] / brightness(base_color[at], mixed), 0).max(axis=0)
        )
        doubts |= (counts & (undecided[at] | hardly[at] | hardly[y, x])).any(axis=0)
    return count, peak, doubts


def _shared(
    inputs: dict[str, NDArray[Any]], terms: Float64, light: Float64, undecided: Bool, pixels: Pixels
) -> tuple[Float64, Float64, Bool]:
    """What `_around` gives of pixels that have a light, for those whose lights each of them shares.

    A pixel is undecided if one is whose light it may share.
    """
    stencil, normal = inputs["stencil"], inputs["normal"]
    background, mixed = is_background(normal), is_mixed(normal)
    place = np.full(stencil.shape, -1)
    place[pixels] = np.arange(len(terms))
    most, peak, doubts = np.zeros(len(terms)), np.zeros((len(terms), 3)), np.zeros(len(terms), bool)
    for there, at in square_rows(stencil.shape, *pixels):
        counts = there & (stencil[at] == stencil[pixels])
        doubts |= (counts & (inputs["valid"][at] == 0) & undecided[at]).any(axis=0)
        counts &= (place[at] >= 0) & (background[at] == background[pixels]) & (mixed[at] == mixed[pixels])
        most = np.maximum(most, np.where(counts, terms[place[at]], 0).max(axis=0))
        peak = np.maximum(peak, np.where(counts[..., None], light[place[at]], 0).max(axis=0))
    return most, peak, doubts
