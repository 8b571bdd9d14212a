# SPDX-License-Identifier: MIT
"""Mistakes in stages motion_chain and warp, and in the code that warp shares with holes and occlusion_warp."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from conformance.protocol.reference_copy import Copy, Mistake, change_arguments, fault, half, put, returns, wrap
from stss_ref.motion_chain import gather_bilinear, gather_nearest, read_motion, squared_lengths, truncated
from stss_ref.sample import Place, Taps, leads_inside

Change = Callable[..., Any]
BOTH = ("holes", "occlusion_warp")
FILL = ("occlusion_warp",)


def _pixels(motion: Any) -> Any:
    return np.stack([*np.indices(motion.shape[:2])][::-1], axis=-1).astype(motion.dtype)


def _times(x: float, y: float) -> Change:
    return lambda motion: motion * np.array((x, y), motion.dtype)


def _on_corners(motion: Any) -> Any:
    height, width, _ = motion.shape
    p, grid = _pixels(motion), np.array((width / max(width - 1, 1), height / max(height - 1, 1)), motion.dtype)
    return ((p + motion) * grid - 0.5) - p


FOLLOWS: tuple[tuple[str, str, Change, tuple[str, ...]], ...] = (
    ("x_sign", "x to the left", _times(-1, 1), BOTH),
    ("y_sign", "y upwards", _times(1, -1), BOTH),
    ("backwards", "follows the motion backwards", _times(-1, -1), BOTH),
    ("axes_swapped", "takes dx for dy", lambda motion: motion[..., ::-1], BOTH),
    ("half_pixel", "pixel centres at halves", lambda motion: motion - 0.5, BOTH),
    ("rounded_sum", "rounds p + m", lambda motion: (_pixels(motion) + motion) - _pixels(motion), BOTH),
    ("half_position", "positions in half precision", lambda motion: half(_pixels(motion) + motion) - _pixels(motion), FILL),
)
"""Changes of a motion before both stages follow it: name, words, the change, and the stages besides warp that show it."""


def _first_again(image: Any) -> Any:
    pixels = image.reshape(-1, image.shape[-1])
    return pixels[np.arange(len(pixels)) % 65536].reshape(image.shape)


def _rows_of_height(image: Any) -> Any:
    height, width, _ = image.shape
    y, x = np.indices((height, width))
    return image.reshape(-1, image.shape[-1])[(y * height + x) % (height * width)]


READS: tuple[tuple[str, str, Change], ...] = (
    ("column_255", "reads nothing behind column 255", lambda image: image[:, np.minimum(np.arange(image.shape[1]), 255)]),
    ("row_511", "reads nothing below row 511", lambda image: image[np.minimum(np.arange(len(image)), 511)]),
    ("pixel_65535", "an index of 16 bits where pixels are read", _first_again),
)
"""Parts of a large image that both stages may read in its place."""


_chain = partial(fault, "motion_chain")


def _follows(name: str, what: str, change: Change) -> Mistake:
    return _chain(name, what, change_arguments("motion_chain.follow", motion=change))


def _longest(name: str, what: str, change: Change) -> Mistake:
    """Of four motions that of the largest ``change`` counts as the longest."""
    return _chain(name, what, returns("motion_chain.squared_lengths", change))


def _still(name: str, what: str, change: Change) -> Mistake:
    return _chain(name, what, put("motion_chain.is_any_still", change))


def _steps(name: str, what: str, change: Change) -> Mistake:
    return _chain(name, what, change_arguments("motion_chain.chain_steps", motions=change))


def _last_of_equals(length: Any) -> Any:
    return np.where(length == length.max(axis=0), np.arange(4)[:, None, None], -1)


def _clamped(motion: Any, x: Any, y: Any) -> Any:
    return motion[np.clip(y, 0, motion.shape[0] - 1), np.clip(x, 0, motion.shape[1] - 1)]


def _longest_inside(motion: Any, at: Place) -> Any:
    x, y = truncated(at.x, at.fx), truncated(at.y, at.fy)
    x, y = (np.stack(places) for places in ((x, x + 1, x, x + 1), (y, y, y + 1, y + 1)))
    corners, inside = read_motion(motion, x, y), (x >= 0) & (x < motion.shape[1]) & (y >= 0) & (y < len(motion))
    longest = np.where(inside, squared_lengths(corners), -1).argmax(axis=0)
    still = (inside & (corners == 0).all(axis=-1)).any(axis=0)
    return np.where(still[..., None], 0, np.take_along_axis(corners, longest[None, ..., None], axis=0)[0])


def _without_last_column(motion: Any, x: Any, y: Any) -> Any:
    return np.where((x == motion.shape[1] - 1)[..., None], 0, read_motion(motion, x, y))


MOTION_CHAIN = (
    *(_follows(name, what, change) for name, what, change, _ in FOLLOWS),
    _follows("not_followed", "adds the motions of one pixel", _times(0, 0)),
    _follows("truncated_motion", "truncates the motion, not the position", np.trunc),
    _chain("floor", "floor for trunc, left of the frame and above it", put("motion_chain.truncated", lambda whole, _: whole)),
    _longest("shortest", "the shortest of four", lambda length: -length),
    _longest("first", "the first of four, not the longest", np.zeros_like),
    _longest("last_of_equals", "the last of equally long ones", _last_of_equals),
    _longest(
        "sum_of_absolutes", "length as |dx| + |dy|", lambda _, corners: np.nan_to_num(np.abs(corners).sum(axis=-1), nan=np.inf)
    ),
    _longest(
        "largest_component",
        "length as max(|dx|, |dy|)",
        lambda _, corners: np.nan_to_num(np.abs(corners).max(axis=-1), nan=np.inf),
    ),
    _longest(
        "column_by_column",
        "of equally long ones that below before that to the right",
        lambda length: np.where(length == length.max(axis=0), np.array([4, 2, 3, 1])[:, None, None], -1),
    ),
    _longest("nan_loses", "a non-finite motion is the shortest", lambda length: np.where(length < np.inf, length, -1)),
    _still("zero_ignored", "a still one among the four does not win", lambda four: np.zeros(four.shape[1:3], bool)),
    _still("zero_component", "dx = 0 alone counts as still", lambda four: (four == 0).any(axis=(0, -1))),
    _still(
        "still_by_bits", "-0 does not count as still", lambda four: ((four == 0) & ~np.signbit(four)).all(axis=-1).any(axis=0)
    ),
    _still("zero_corner", "only the first of four may be still", lambda four: (four[0] == 0).all(axis=-1)),
    _still(
        "zero_nearly", "below 1/128 of a pixel counts as still", lambda four: (np.abs(four) < 2.0**-7).all(axis=-1).any(axis=0)
    ),
    _steps("one_step_short", "k - 1 steps", lambda motions: motions[: max(1, len(motions) - 1)]),
    _steps(
        "newest_throughout", "reads the newest motion throughout", lambda motions: np.broadcast_to(motions[:1], motions.shape)
    ),
    _steps("five_steps", "up to five steps", lambda motions: motions[:5]),
    _steps("oldest_first", "takes the motions as oldest first", lambda motions: motions[::-1]),
    _chain("border_clamped", "the nearest pixel outside the frame, not 0", put("motion_chain.read_motion", _clamped)),
    _chain(
        "outside_left_out",
        "leaves out motions outside the frame, not 0",
        put("motion_chain.GATHERS", {"longest": _longest_inside}),
    ),
    _chain("rows_of_height", "H for W: a row of H pixels", change_arguments("motion_chain.read_motion", motion=_rows_of_height)),
    _chain("last_column_outside", "column W - 1 is outside", put("motion_chain.read_motion", _without_last_column)),
    _chain("nearest", "the nearest pixel's motion", put("motion_chain.GATHERS", {"longest": gather_nearest})),
    _chain("bilinear", "interpolates motion", put("motion_chain.GATHERS", {"longest": gather_bilinear})),
    *(
        _chain(name, what, change_arguments("motion_chain.read_motion", motion=change), large=True)
        for name, what, change in READS
    ),
)


_warp = partial(fault, "warp")
FAST_MATH = "non-finite motion is not told apart, as in a build with fast-math"


def _takes(name: str, what: str, change: Change, also: tuple[str, ...] = BOTH, **marks: Any) -> Mistake:
    """Motion is followed after a ``change``, but is lost where it was."""

    def wrong(follow: Callable[[Any], Place], motion: Any) -> Place:
        return follow(change(motion))._replace(finite=follow(motion).finite)

    return _warp(name, what, wrap("sample.follow", wrong), also=also, **marks)


def _place(name: str, what: str, change: Callable[[Place, int, int], Place]) -> Mistake:
    """Pixels are read around another place; the arguments of ``change`` are the place, height and width."""
    return _warp(name, what, change_arguments("sample.taps", at=lambda at: change(at, *at.x.shape)), also=FILL)


def _taps(name: str, what: str, change: Callable[[Taps, Place], Taps], also: tuple[str, ...] = FILL) -> Mistake:
    return _warp(name, what, returns("sample.taps", change), also=also)


def _inside(name: str, what: str, change: Callable[[Place, int, int], Any]) -> Mistake:
    """``change`` says what is on screen; its arguments as those of `_place`."""
    return _warp(name, what, put("sample.leads_inside", lambda at: change(at, *at.x.shape)), also=("holes",))


def _fractions(name: str, what: str, change: Change, also: tuple[str, ...] = BOTH) -> Mistake:
    return _warp(
        name, what, change_arguments("sample.between", at=lambda at: at._replace(fx=change(at.fx), fy=change(at.fy))), also=also
    )


def _image(name: str, what: str, change: Change) -> Mistake:
    return _warp(name, what, returns("warp.warp", lambda result: (change(*result), result[1])))


def _border_of_0(copy: Copy) -> None:
    """Each of the four pixels is 0 where it lies outside the frame."""

    def taps(at: Place) -> Taps:
        return Taps(at.x, at.y, at.x + 1, at.y + 1, at.fx, at.fy)

    def corners(image: Any, at: Taps) -> list[Any]:
        height, width, _ = image.shape
        return [
            np.where(((y >= 0) & (y < height) & (x >= 0) & (x < width))[..., None], _clamped(image, x, y), 0)
            for y in (at.y0, at.y1)
            for x in (at.x0, at.x1)
        ]

    copy.put("warp.taps", taps)
    copy.put("sample.corners", corners)


def _tile_seam(at: Place) -> Place:
    at.y[8::16] -= 1
    return at


WARP = (
    *(_takes(name, what, change, also) for name, what, change, also in FOLLOWS),
    _takes("corners_grid", "normalises with corners aligned, samples with centres aligned", _on_corners),
    _takes(
        "nan_component",
        "only the non-finite component counts as 0",
        lambda motion: np.where(np.isfinite(motion), motion, 0),
        FILL,
    ),
    _warp(
        "finite_by_sum",
        "motion whose components' sum is not finite is lost",
        change_arguments("sample.follow", motion=lambda m: np.where(np.isfinite(m.sum(axis=-1, keepdims=True)), m, np.nan)),
        also=FILL,
    ),
    _takes(
        "nan_first_pixel",
        "non-finite motion, clamped, is the first pixel",
        lambda motion: np.where(np.isfinite(motion).all(axis=-1, keepdims=True), motion, -1e9),
        FILL,
    ),
    *(
        _takes(
            name,
            what,
            lambda motion, nan=nan: np.nan_to_num(motion, nan=nan, posinf=1e9, neginf=-1e9),
            FILL,
        )
        for name, what, nan in (
            ("nan_clamped_low", f"{FAST_MATH}: NaN is clamped to the first pixel", -1e9),
            ("nan_clamped_high", f"{FAST_MATH}: NaN is clamped to the last pixel", 1e9),
            ("infinity_clamped", "infinite motion is clamped, and only NaN told apart", np.nan),
        )
    ),
    _takes(
        "motion_32", "motion is clamped to 32 pixels", lambda motion: motion.clip(-32, 32), ("motion_chain", *BOTH), large=True
    ),
    _place(
        "border_wraps", "outside the frame its other side", lambda at, height, width: at._replace(x=at.x % width, y=at.y % height)
    ),
    _taps(
        "fraction_unclamped",
        "clamps the pixels, keeps the fraction of the position",
        lambda four, at: four._replace(fx=at.fx, fy=at.fy),
    ),
    _taps(
        "last_column_unread",
        "clamps x to W - 2, where two pixels still fit",
        lambda four, at: four._replace(x0=np.minimum(four.x0, max(at.x.shape[1] - 2, 0))),
        BOTH,
    ),
    _inside(
        "inside_to_width", "between W - 1 and W is inside", lambda at, h, w: leads_inside(at._replace(fx=at.fx * 0, fy=at.fy * 0))
    ),
    _inside("inside_without_zero", "x = 0 is outside", lambda at, _, __: leads_inside(at) & (at.x + at.fx > 0)),
    _inside("inside_without_last", "row H - 1 is outside", lambda at, height, _: leads_inside(at) & (at.y < height - 1)),
    _inside("inside_x_only", "only x can be off screen", lambda at, _, __: leads_inside(at._replace(y=at.y * 0, fy=at.fy * 0))),
    _taps(
        "sides_swapped",
        "H for W: x is clamped to H - 1",
        lambda four, at: four._replace(x0=np.minimum(four.x0, len(at.x) - 1), x1=np.minimum(four.x1, len(at.x) - 1)),
        BOTH,
    ),
    _inside(
        "inside_sides_swapped",
        "H for W: on screen up to H - 1 across",
        lambda at, h, _: leads_inside(at) & (at.x + at.fx <= h - 1),
    ),
    _warp("rows_of_height", "H for W: a row of H pixels", change_arguments("sample.corners", image=_rows_of_height), also=BOTH),
    _inside("inside_clamped", "tests the position after clamping it", lambda at, _, __: at.finite),
    _inside("nan_inside", "non-finite motion is on screen", lambda at, _, __: leads_inside(at) | ~at.finite),
    _warp(
        "lerp_of_products",
        "a (1 - t) + b t: a flat image is no longer flat",
        put("sample.lerp", lambda a, b, t: a * (1 - t) + b * t),
        bits=True,
    ),
    _warp(
        "fractions_swapped",
        "fx for fy",
        change_arguments("sample.between", at=lambda at: at._replace(fx=at.fy, fy=at.fx)),
        also=BOTH,
    ),
    _fractions("nearest", "the nearest pixel", np.round),
    _fractions("texture_fraction", "a texture sampler, whose fraction has 8 bits", lambda t: np.floor(t * 256) / 256, FILL),
    _image("border_black", "0 outside the frame", lambda warped, inside: warped * inside[..., None]),
    _warp("sampler_border_0", "a sampler with a border of 0: each pixel outside the frame reads as 0", _border_of_0),
    _image("half_output", "warped colours in half precision", lambda warped, _: half(warped)),
    _image(
        "last_group",
        "the last pixels stay 0, where they fill no group of 64",
        lambda image, _: (
            image.reshape(-1, image.shape[-1])
            * (np.arange(image.shape[0] * image.shape[1]) < image.shape[0] * image.shape[1] // 64 * 64)[:, None]
        ).reshape(image.shape),
    ),
    _image("four_channels", "channels from the fifth on stay 0", lambda image, _: image * (np.arange(image.shape[-1]) < 4)),
    _image("sixteen_channels", "channels from the 17th on stay 0", lambda image, _: image * (np.arange(image.shape[-1]) < 16)),
    _image(
        "tail_of_row",
        "the last pixels of a row stay 0 where W is no multiple of 4",
        lambda image, _: image * (np.arange(image.shape[1]) < image.shape[1] // 4 * 4)[:, None],
    ),
    _warp("bgr", "colours in reverse", change_arguments("warp.warp", color=lambda color: color[..., ::-1])),
    _warp("inside_inverted", "1 where it is off screen", returns("warp.leads_inside", np.logical_not)),
    _warp("tile_seam", "the first row of every other tile of 8 reads one row above", returns("warp.follow", _tile_seam)),
    *(_warp(name, what, change_arguments("sample.corners", image=change), also=BOTH, large=True) for name, what, change in READS),
)
