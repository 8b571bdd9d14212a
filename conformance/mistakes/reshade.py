# SPDX-License-Identifier: MIT
"""Mistakes in stage reshade."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from inspect import signature
from typing import Any

import numpy as np

from conformance.protocol.reference_copy import Copy, Mistake, change_arguments, fault, put, returns, wrap
from stss_ref.reshade import COSINE, FLOOR, REACH, STEPS, UNMIXED

Change = Callable[..., Any]
_reshade = partial(fault, "reshade")


def _takes(name: str, what: str, **changes: Change) -> Mistake:
    """The stage is given others."""
    return _reshade(name, what, change_arguments("reshade.reshade", **changes))


def _samples(name: str, what: str, change: Callable[[list[Any]], list[Any]]) -> Mistake:
    """Others of the four pixels are samples; each is whether it lies in the frame, its row and its column."""
    return _reshade(name, what, returns("reshade.four_samples", lambda four: iter(change([*four]))))


def _like(name: str, what: str, **changes: Change) -> Mistake:
    return _reshade(name, what, change_arguments("reshade.like_sums", **changes))


def _weights(name: str, what: str, weigh: Callable[[Any, Any, Any], Any]) -> Mistake:
    """Materials weigh ``weigh`` of the differences of their base colours and normals, and of their squared distance."""

    def wrong(base_color: Any, own_base_color: Any, normal: Any, own_normal: Any, away: Any) -> Any:
        return weigh(base_color - own_base_color, normal - own_normal, away)

    return _reshade(name, what, put("reshade.likeness", wrong))


def _power(base: Any, normal: Any, away: Any, power: float = 4.0) -> Any:
    apart, turned = np.abs(base).sum(axis=-1), (normal * normal).sum(axis=-1)
    return (1 + apart + 2 * turned + 0.25 * away) ** -power


def _reflect(name: str, what: str, make: Callable[[Any], Any]) -> Mistake:
    """Base colours make ``make`` of them of light 1."""

    def wrong(base_color: Any, mixed: Any) -> Any:
        return np.where(mixed[:, None], base_color.dtype.type(1), make(base_color))

    return _reshade(name, what, put("reshade.brightness", wrong))


def _mean_of_lights(copy: Copy) -> None:
    """The light is the mean of the sources' lights: a dark source counts as much as a bright one."""
    brightness = copy.get("reshade.brightness")

    def like_sums(right: Change, color: Any, is_source: Any, stencil: Any, normal: Any, base_color: Any, y: Any, x: Any) -> Any:
        light = color / brightness(base_color, np.zeros(base_color.shape[1], bool))
        mixed = (normal[y, x] * normal[y, x]).sum(axis=-1) < UNMIXED
        (plain, weights), (sums, totals) = (
            _unlit(right, each, is_source, stencil, normal, base_color, y, x) for each in (color, light)
        )
        return np.where(mixed[:, None], plain, sums), np.where(mixed[:, None], weights, totals)

    def _unlit(right: Change, *arguments: Any) -> Any:
        copy.put("reshade.brightness", lambda base_color, mixed: np.ones_like(base_color))
        got = right(*arguments)
        copy.put("reshade.brightness", brightness)
        return got

    wrap("reshade.like_sums", like_sums)(copy)


def _in_place(copy: Copy) -> None:
    """Colours that holes of moving objects have taken are sources of the holes after them."""
    brightness, is_mixed = copy.get("reshade.brightness"), copy.get("reshade.is_mixed")

    def like_sums(right: Change, color: Any, is_source: Any, stencil: Any, normal: Any, base_color: Any, y: Any, x: Any) -> Any:
        color = color.copy()
        for at in ((y[i : i + 1], x[i : i + 1]) for i in np.flatnonzero(is_source[y, x])):
            sums, totals = right(color, is_source, stencil, normal, base_color, *at)
            if (totals > 0).all():
                color[at] = brightness(base_color[at], is_mixed(normal[at])) * sums / totals
        return right(color, is_source, stencil, normal, base_color, y, x)

    wrap("reshade.like_sums", like_sums)(copy)


def _shares(name: str, what: str, **changes: Change) -> Mistake:
    """Holes take the mean of other lights."""
    return _reshade(name, what, change_arguments("reshade.light_sums", **changes))


def _shares_by(name: str, what: str, function: str, other: Change) -> Mistake:
    """``function`` is ``other``, for the mean of lights alone."""

    def plant(copy: Copy) -> None:
        own = copy.get(f"reshade.{function}")

        def light_sums(right: Change, *arguments: Any) -> Any:
            copy.put(f"reshade.{function}", other)
            got = right(*arguments)
            copy.put(f"reshade.{function}", own)
            return got

        wrap("reshade.light_sums", light_sums)(copy)

    return _reshade(name, what, plant)


def _mean_of_colors(copy: Copy) -> None:
    """Holes take the mean of their neighbours' colours."""
    brightness, is_mixed = copy.get("reshade.brightness"), copy.get("reshade.is_mixed")

    def light_sums(right: Change, light: Any, has: Any, stencil: Any, normal: Any, base_color: Any, y: Any, x: Any) -> Any:
        flat = base_color.reshape(-1, 3), is_mixed(normal).reshape(-1)
        sums, totals = right(light * brightness(*flat).reshape(light.shape), has, stencil, normal, base_color, y, x)
        return sums / brightness(base_color[y, x], is_mixed(normal[y, x])), totals

    wrap("reshade.light_sums", light_sums)(copy)


def _lights_in_place(copy: Copy) -> None:
    """The mean of a hole's lights is the light of those after it."""

    def light_sums(right: Change, light: Any, has: Any, stencil: Any, normal: Any, base_color: Any, y: Any, x: Any) -> Any:
        light = light.copy()
        for at in ((y[i : i + 1], x[i : i + 1]) for i in range(len(y))):
            sums, totals = right(light, has, stencil, normal, base_color, *at)
            light[at] = sums / totals
        return light[y, x], np.ones((len(y), 1), light.dtype)

    wrap("reshade.light_sums", light_sums)(copy)


def _within_tile(right: Change, color: Any, is_source: Any, stencil: Any, normal: Any, base_color: Any, y: Any, x: Any) -> Any:
    """Windows end at the tiles of 8 x 8 that their pixels lie in."""
    sums, totals = np.zeros((2, len(y), 3), color.dtype)
    for top, left in {(int(row), int(column)) for row, column in zip(y // 8 * 8, x // 8 * 8, strict=True)}:
        own, tile = (y // 8 * 8 == top) & (x // 8 * 8 == left), (slice(top, top + 8), slice(left, left + 8))
        planes = (plane[tile] for plane in (color, is_source, stencil, normal, base_color))
        sums[own], totals[own] = right(*planes, y[own] - top, x[own] - left)
    return sums, totals


def _whole_squares(size: Any, y: Any, x: Any) -> Any:
    """All places within a ring count."""
    height, width = size
    places = np.arange(-REACH, REACH + 1)
    for step in STEPS:
        for row in (y + step * place for place in places):
            column = x + step * places[:, None]
            there = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            yield there, (np.clip(row, 0, height - 1), np.clip(column, 0, width - 1))


def _all_there(rows: Any) -> Any:
    return ((there | True, at) for there, at in rows)


def _nearest(copy: Copy) -> None:
    """Holes look at a wider ring only where the narrower ones have no source."""

    def like_sums(right: Change, *arguments: Any) -> Any:
        sums, totals = right(*arguments)
        for step in reversed(STEPS):
            copy.put("reshade.STEPS", (step,))
            own, total = right(*arguments)
            found = (total > 0).all(axis=-1)
            sums[found], totals[found] = own[found], total[found]
        copy.put("reshade.STEPS", STEPS)
        return sums, totals

    wrap("reshade.like_sums", like_sums)(copy)


def _samples_no_sources(copy: Copy) -> None:
    """Every pixel that is no hole is a source."""
    valids: list[Any] = []

    def whole(right: Change, *arguments: Any, **keywords: Any) -> Any:
        valids[:] = [_valid_of(right, arguments, keywords)]
        return right(*arguments, **keywords)

    def like_sums(right: Change, color: Any, is_source: Any, *others: Any) -> Any:
        return right(color, is_source & (valids[0] != 0), *others)

    wrap("reshade.reshade", whole)(copy)
    wrap("reshade.like_sums", like_sums)(copy)


def _clamped_late(copy: Copy) -> None:
    """Colours below 0 of samples count in their sum, which is at least 0."""
    colors: list[Any] = []

    def whole(right: Change, color: Any, **others: Any) -> Any:
        colors[:] = [color]
        return right(color, **others)

    def own_samples(right: Change, _: Any, *others: Any) -> Any:
        sums, counts = right(colors[0], *others)
        return np.maximum(sums, 0), counts

    wrap("reshade.reshade", whole)(copy)
    wrap("reshade.own_samples", own_samples)(copy)


def _valid_of(function: Change, arguments: Any, keywords: Any) -> Any:
    return signature(function).bind(*arguments, **keywords).arguments["valid"]


RESHADE = (
    _takes("unfilled", "holes are left as they are", valid=np.ones_like),
    _takes("filled_everywhere", "fills valid pixels, too", valid=np.zeros_like),
    _takes("valid_inverted", "fills all but the holes", valid=lambda valid: (valid == 0).astype(valid.dtype)),
    _takes("stencil_of_now", "this frame's object numbers for the earlier ones", stencil_previous=lambda _, stencil: stencil),
    _takes("normal_of_now", "this frame's normals for the earlier ones", normal_previous=lambda _, normal: normal),
    _takes("position_of_now", "this frame's positions for the earlier ones", position_previous=lambda _, position: position),
    _takes("objects_ignored", "one object", stencil=np.zeros_like, stencil_previous=np.zeros_like),
    _takes("backwards", "follows the motion backwards", motion=np.negative),
    _takes(
        "lost_at_its_place",
        "non-finite motion counts as 0",
        motion=lambda motion: np.where(np.isfinite(motion).all(axis=-1)[..., None], motion, 0),
    ),
    _takes("half_pixel", "pixel centres at halves", motion=lambda motion: motion - 0.5),
    _samples("one_sample", "looks at one of four", lambda four: four[:1]),
    _samples("three_samples", "looks at three of four", lambda four: four[:3]),
    _samples("outside_clamped", "the nearest pixel for one outside", lambda four: [(there | True, *at) for there, *at in four]),
    _samples(
        "all_in_frame",
        "samples only where all four lie in the frame",
        lambda four: [(np.all([there for there, *_ in four], axis=0), *at) for _, *at in four],
    ),
    _reshade("no_samples", "no samples of their own", returns("reshade.own_samples", lambda got: (got[0], got[1] * 0))),
    _reshade(
        "sum_of_samples",
        "the sum of the samples, not their mean",
        returns("reshade.own_samples", lambda got: (got[0], np.minimum(got[1], 1))),
    ),
    _reshade(
        "every_sample", "samples of any surface", put("reshade.shows_surface", lambda before, now, sample, pixel: np.bool_(True))
    ),
    _reshade("far_samples", "samples within four footprints", put("reshade.FOOTPRINTS", 4.0)),
    _reshade("near_samples", "samples within one footprint", put("reshade.FOOTPRINTS", 1.0)),
    _reshade("cosine_098", "the cosine of stage holes", put("reshade.COSINE", 0.98)),
    _reshade("reach_1", "rings of 3 x 3 places", put("reshade.REACH", 1)),
    _reshade("reach_3", "rings of 7 x 7 places", put("reshade.REACH", 3)),
    _reshade("no_widest", "no ring with steps of 32 pixels", put("reshade.STEPS", (1, 2, 4, 8, 16)), large=True),
    _reshade("no_nearest", "no ring with steps of a pixel", put("reshade.STEPS", (2, 4, 8, 16, 32))),
    _reshade("whole_squares", "all places within a ring count, too", put("reshade.ring_rows", _whole_squares)),
    _reshade("first_ring", "the first ring that has a source, alone", _nearest),
    _reshade("clamped_rings", "the nearest pixel for a place outside", returns("reshade.ring_rows", _all_there)),
    _reshade("samples_no_sources", "holes with samples are no sources", _samples_no_sources),
    _like("all_are_sources", "holes are sources, too", is_source=np.ones_like),
    _like("all_objects", "materials of all objects", stencil=np.zeros_like),
    _weights("uniform", "all weigh the same", lambda base, normal, away: np.ones(base.shape[:-1], base.dtype)),
    _weights("no_normals", "normals do not count", lambda base, normal, away: _power(base, normal * 0, away)),
    _weights("no_base_colors", "base colours do not count", lambda base, normal, away: _power(base * 0, normal, away)),
    _weights("squared", "the square, not the fourth power", lambda base, normal, away: _power(base, normal, away, 2.0)),
    _weights(
        "length",
        "the length of the base colours' difference",
        lambda base, normal, away: _power(
            np.sqrt((base * base).sum(axis=-1, keepdims=True)) * np.array([1, 0, 0], base.dtype), normal, away
        ),
    ),
    _weights(
        "signed", "base colours by their signed difference", lambda base, normal, away: _power(np.maximum(base, 0), normal, away)
    ),
    _weights("base_colors_8", "base colours weigh eight times", lambda base, normal, away: _power(8 * base, normal, away)),
    _weights("near_as_far", "distance does not count", lambda base, normal, away: _power(base, normal, away * 0)),
    _weights("by_length", "distance, not its square", lambda base, normal, away: _power(base, normal, np.sqrt(away))),
    _reflect("colors_not_light", "the mean of the sources' colours, not their light", np.ones_like),
    _reflect("not_a_root", "colours as if they were linear", lambda base: np.clip(base, 0, 1) + base.dtype.type(FLOOR)),
    _reflect("no_floor", "black reflects a millionth", lambda base: np.sqrt(np.clip(base, 1e-6, 1))),
    _reflect(
        "floor_outside", "the floor is added to the root", lambda base: np.sqrt(np.clip(base, 0, 1)) + base.dtype.type(0.125)
    ),
    _reflect("above_1", "base colours above 1 stay", lambda base: np.sqrt(np.maximum(base, 0) + base.dtype.type(FLOOR))),
    _reflect(
        "below_0",
        "base colours below 0 by their absolute value",
        lambda base: np.sqrt(np.minimum(np.abs(base), 1) + base.dtype.type(FLOOR)),
    ),
    _reflect(
        "one_channel",
        "the brightness of green for all channels",
        lambda base: np.sqrt(np.clip(base[..., 1:2], 0, 1) + base.dtype.type(FLOOR)) + 0 * base,
    ),
    _reshade(
        "moving_own",
        "a moving object's holes take their own samples, too",
        returns("reshade.like_sums", lambda got, is_source, y, x: (got[0], got[1] * ~is_source[y, x][:, None])),
    ),
    _reshade("in_place", "colours of moving objects' holes are sources of others", _in_place),
    _reshade("mean_of_lights", "the mean of the sources' lights", _mean_of_lights),
    _reshade(
        "one_total",
        "the first channel's sum of weights for all channels",
        returns("reshade.like_sums", lambda got: (got[0], got[1][:, :1] + 0 * got[1])),
    ),
    _reshade(
        "mixed_too",
        "base colours of mixed pixels count",
        put("reshade.is_mixed", lambda normal: np.zeros(normal.shape[:-1], bool)),
    ),
    _reshade(
        "mixed_by_length",
        "pixels with a normal shorter than 1/4 are mixed",
        put("reshade.is_mixed", lambda normal: np.asarray((normal * normal).sum(axis=-1) < UNMIXED**2)),
    ),
    _reshade(
        "no_background",
        "a background is a surface like others",
        put("reshade.is_background", lambda normal: np.zeros(normal.shape[:-1], bool)),
    ),
    _reshade(
        "faint_is_background",
        "normals shorter than 1e-6 are a background's",
        put("reshade.is_background", lambda normal: (normal * normal).sum(axis=-1) < 1e-12),
    ),
    _reshade(
        "background_by_z",
        "a background is where z of the normal is 0",
        put("reshade.is_background", lambda normal: np.asarray(normal[..., 2] == 0)),
    ),
    _reshade("clamped_late", "the sum of samples, not each of them, is at least 0", _clamped_late),
    _reshade("leaning_samples", "static samples of any normal", put("reshade.STATIC_COSINE", -2.0)),
    _reshade("cosine_for_all", "the cosine of moving objects for static ones, too", put("reshade.STATIC_COSINE", COSINE)),
    _reshade("own_light", "holes take the light that they find themselves", put("reshade.LIGHT_REACH", 0)),
    _reshade("share_1", "the mean of the lights of 3 x 3 holes", put("reshade.LIGHT_REACH", 1)),
    _reshade("share_3", "the mean of the lights of 7 x 7 holes", put("reshade.LIGHT_REACH", 3)),
    _reshade("share_clamped", "the lights of the nearest hole for one outside", returns("reshade.square_rows", _all_there)),
    _shares("share_all_objects", "the lights of all objects", stencil=np.zeros_like),
    _shares_by(
        "share_unlike",
        "all lights weigh the same",
        "likeness",
        lambda base_color, own_base_color, normal, own_normal, away: np.ones(base_color.shape[:-1], base_color.dtype),
    ),
    _shares_by("share_mixed", "lights of mixed holes for others", "is_mixed", lambda normal: np.zeros(normal.shape[:-1], bool)),
    _shares_by(
        "share_background",
        "lights of a background for surfaces",
        "is_background",
        lambda normal: np.zeros(normal.shape[:-1], bool),
    ),
    _reshade("share_colors", "the mean of colours, not of lights", _mean_of_colors),
    _reshade("share_in_place", "the mean of a hole's lights is the light of others", _lights_in_place),
    _reshade("share_tile", "the lights of tiles of 8 x 8", wrap("reshade.light_sums", _within_tile)),
    _reshade("tile_halo", "windows end at tiles of 8 x 8", wrap("reshade.like_sums", _within_tile)),
    _reshade(
        "negative_color",
        "colours below 0 stay",
        returns("reshade.reshade", lambda filled, warped, valid: np.where(valid[..., None] != 0, warped, filled)),
    ),
    _reshade(
        "black",
        "black where nothing is alike",
        returns(
            "reshade.reshade",
            lambda filled, warped, valid: np.where((valid[..., None] == 0) & (filled == np.maximum(warped, 0)), 0, filled),
        ),
    ),
)
