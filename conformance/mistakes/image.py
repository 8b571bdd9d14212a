# SPDX-License-Identifier: MIT
"""Mistakes in stages motion_chain and warp, and in the code that warp shares with holes and occlusion_warp."""

from collections.abc import Sequence
from typing import Any

from conformance.mistakes.variants import Change, Mistake, fault

BOTH = ("holes", "occlusion_warp")
CHAIN = "motion_chain.py"
SAMPLE = "sample.py"

_FOLLOWED = "at = follow(chained)"
_P = "p = np.stack(np.indices(chained.shape[:2])[::-1], axis=-1).astype(chained.dtype)"
_SQUARES = "length = (corners * corners).sum(axis=-1)"
_DEFAULT = "def motion_chain(motions: Image, gather: Gather = "
_STILL = "still = (corners == 0).all(axis=-1).any(axis=0)"
_OVER = "for earlier in motions[1:]:"
_STEP = "chained = chain_on(chained, earlier, gather)"


def _chain(name: str, what: str, *change: str, more: Sequence[Change] = ()) -> Mistake:
    return fault("motion_chain", name, what, CHAIN, *change, more=more)


MOTION_CHAIN = (
    _chain("x_sign", "follows x to the other side", _FOLLOWED, "at = follow(chained * np.array((-1, 1), chained.dtype))"),
    _chain("y_sign", "follows y to the other side", _FOLLOWED, "at = follow(chained * np.array((1, -1), chained.dtype))"),
    _chain("backwards", "follows the motion backwards", _FOLLOWED, "at = follow(-chained)"),
    _chain("axes_swapped", "takes dx for dy", _FOLLOWED, "at = follow(chained[..., ::-1])"),
    _chain("not_followed", "adds the motions of one pixel", _FOLLOWED, "at = follow(chained * 0)"),
    _chain("rounded_sum", "rounds p + m", _FOLLOWED, f"{_P}\n    at = follow((p + chained) - p)"),
    _chain(
        "half_position",
        "positions in half precision",
        _FOLLOWED,
        f"{_P}\n    at = follow((p + chained).astype(np.float16).astype(chained.dtype) - p)",
    ),
    _chain("floor", "floor for trunc, left of the frame and above it", "(whole == -1) & (fraction > 0)", "np.False_"),
    _chain("half_pixel", "pixel centres at halves", _FOLLOWED, "at = follow(chained + chained.dtype.type(0.5))"),
    _chain("truncated_motion", "truncates the motion, not the position", _FOLLOWED, "at = follow(np.trunc(chained))"),
    _chain("shortest", "the shortest of four", "length.argmax(axis=0)", "length.argmin(axis=0)"),
    _chain("first", "the first of four, not the longest", "length.argmax(axis=0)", "np.zeros(length.shape[1:], np.intp)"),
    _chain("last_of_equals", "the last of equally long ones", "length.argmax(axis=0)", "(3 - length[::-1].argmax(axis=0))"),
    _chain("sum_of_absolutes", "length as |dx| + |dy|", _SQUARES, "length = np.abs(corners).sum(axis=-1)"),
    _chain("zero_ignored", "a still one among the four does not win", _STILL, "still = np.False_"),
    _chain("zero_component", "dx = 0 alone counts as still", _STILL, "still = (corners == 0).any(axis=-1).any(axis=0)"),
    _chain(
        "still_by_bits",
        "-0 does not count as still",
        _STILL,
        "still = (corners.view(f'u{corners.itemsize}') == 0).all(axis=-1).any(axis=0)",
    ),
    _chain("zero_corner", "only the first of four may be still", _STILL, "still = (corners[0] == 0).all(axis=-1)"),
    _chain(
        "zero_nearly",
        "below 1/128 of a pixel counts as still",
        _STILL,
        "still = (np.abs(corners) < 2.0**-7).all(axis=-1).any(axis=0)",
    ),
    _chain("one_step_short", "k - 1 steps", _OVER, "for earlier in motions[1:-1]:"),
    _chain("newest_throughout", "reads the newest motion at every step", _STEP, _STEP.replace("earlier", "motions[0]")),
    _chain(
        "oldest_first",
        "takes the motions as oldest first",
        _OVER,
        "for earlier in motions[-2::-1]:",
        more=[(CHAIN, "chained = motions[0]", "chained = motions[-1]")],
    ),
    _chain(
        "border_clamped",
        "the nearest pixel outside the frame, not 0",
        "return np.where(inside[..., None], motion[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)], 0)",
        "return motion[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]",
    ),
    _chain(
        "far_is_corner",
        "far outside reads the first pixel",
        _FOLLOWED,
        f"{_FOLLOWED}\n    far = (np.abs(chained) > max(chained.shape)).any(axis=-1)\n"
        "    at = at._replace(x=np.where(far, 0, at.x), y=np.where(far, 0, at.y))",
    ),
    _chain("last_column_outside", "column W - 1 is outside", "(x < width) & (y >= 0)", "(x < width - 1) & (y >= 0)"),
    _chain("nan_loses", "a non-finite motion is the shortest", ".all(axis=-1), length, np.inf)", ".all(axis=-1), length, -1)"),
    _chain("nearest", "the nearest pixel's motion", f'{_DEFAULT}"longest"', f'{_DEFAULT}"nearest"'),
    _chain("bilinear", "interpolates motion", f'{_DEFAULT}"longest"', f'{_DEFAULT}"bilinear"'),
)

_FOLLOW = "moved = np.where(finite[..., None], motion, 0)"
_CLAMP = "x0, y0 = np.clip(at.x, 0, width - 1), np.clip(at.y, 0, height - 1)"
_ACROSS, _DOWN = "(at.x + (at.fx > 0) <= width - 1)", "(at.y + (at.fy > 0) <= height - 1)"
_INSIDE = "return at.finite & across & down"
_FRACTION = "fx = np.where((at.x < 0) | (at.x >= width - 1), 0, at.fx)"
_RETURN = "return bilinear(color, taps(at)), leads_inside(at)"
_FRACTIONS = "fx, fy = at.fx[..., None], at.fy[..., None]"
_WRAPPED_TAP = (SAMPLE, "np.minimum(x0 + 1, width - 1), ", "(x0 + 1) % width, ")


def _summed(position: str) -> str:
    """Changed source that follows a motion through a position, which is a sum of pixel ``p`` and ``moved``."""
    p = "p = np.stack(np.indices(motion.shape[:2])[::-1], axis=-1).astype(motion.dtype)"
    return f"{_FOLLOW}\n    {p}\n    moved = {position} - p"


def _warp(name: str, what: str, *change: str, **marks: Any) -> Mistake:
    return fault("warp", name, what, *change, **marks)


WARP = (
    _warp("x_sign", "x to the left", SAMPLE, _FOLLOW, f"{_FOLLOW} * np.array((-1, 1), motion.dtype)", also=BOTH),
    _warp("y_sign", "y upwards", SAMPLE, _FOLLOW, f"{_FOLLOW} * np.array((1, -1), motion.dtype)", also=BOTH),
    _warp("backwards", "follows the motion backwards", SAMPLE, _FOLLOW, f"{_FOLLOW} * -1", also=BOTH),
    _warp("axes_swapped", "takes dx for dy", SAMPLE, _FOLLOW, f"{_FOLLOW}[..., ::-1]", also=BOTH),
    _warp("half_pixel", "pixel centres at halves", SAMPLE, _FOLLOW, f"{_FOLLOW} - motion.dtype.type(0.5)", also=BOTH),
    _warp("rounded_sum", "rounds p + m, and takes the fraction of that", SAMPLE, _FOLLOW, _summed("(p + moved)"), also=BOTH),
    _warp(
        "centres",
        "rounds (p + 1/2) + m - 1/2, by way of pixel centres",
        SAMPLE,
        _FOLLOW,
        _summed("((p + 0.5 + moved) - 0.5)"),
        also=BOTH,
    ),
    _warp(
        "corners_grid",
        "normalises with corners aligned, samples with centres aligned",
        SAMPLE,
        _FOLLOW,
        _summed("((p + moved) * np.array((width / max(width - 1, 1), height / max(height - 1, 1)), motion.dtype) - 0.5)"),
        also=BOTH,
    ),
    _warp(
        "border_wraps",
        "outside the frame its other side",
        SAMPLE,
        _CLAMP,
        "x0, y0 = at.x % width, at.y % height",
        also=("occlusion_warp",),
    ),
    _warp(
        "border_mirrored",
        "outside the frame its mirror image",
        SAMPLE,
        _CLAMP,
        "x0, y0 = np.clip(np.abs(at.x), 0, width - 1), np.clip(np.abs(at.y), 0, height - 1)",
        also=("occlusion_warp",),
    ),
    _warp(
        "border_black",
        "0 outside the frame",
        "warp.py",
        _RETURN,
        "return bilinear(color, taps(at)) * leads_inside(at)[..., None], leads_inside(at)",
    ),
    _warp(
        "fraction_unclamped",
        "clamps the pixels, keeps the fraction of the position",
        SAMPLE,
        _FRACTION,
        "fx = at.fx",
        also=("occlusion_warp",),
    ),
    _warp(
        "clamped_to_width",
        "clamps x to W, not W - 1: the last column blends into the next row",
        SAMPLE,
        _FRACTION,
        "fx = np.where(at.x < 0, 0, np.where(at.x >= width, 1 - 2.0**-6, at.fx))",
        more=[_WRAPPED_TAP],
        also=("occlusion_warp",),
    ),
    _warp(
        "last_column_unread",
        "clamps x to W - 2, where two pixels still fit",
        SAMPLE,
        _CLAMP,
        "x0, y0 = np.clip(at.x, 0, max(width - 2, 0)), np.clip(at.y, 0, height - 1)",
        also=BOTH,
    ),
    _warp("inside_to_width", "between W - 1 and W is inside", SAMPLE, _ACROSS, "(at.x <= width - 1)", also=("holes",)),
    _warp(
        "inside_without_zero",
        "x = 0 is outside",
        SAMPLE,
        "across = (at.x >= 0)",
        "across = (at.x + at.fx > 0)",
        also=("holes",),
    ),
    _warp("inside_without_last", "row H - 1 is outside", SAMPLE, _DOWN, _DOWN.replace("<=", "<"), also=("holes",)),
    _warp("inside_x_only", "only x can be off screen", SAMPLE, _INSIDE, "return at.finite & across", also=("holes",)),
    _warp(
        "inside_sides_swapped",
        "tests x against the height",
        SAMPLE,
        _ACROSS,
        _ACROSS.replace("width", "height"),
        more=[(SAMPLE, _DOWN, _DOWN.replace("height", "width"))],
        also=("holes",),
    ),
    _warp("inside_clamped", "tests the position after clamping it", SAMPLE, _INSIDE, "return at.finite", also=("holes",)),
    _warp(
        "inside_inverted", "1 where it is off screen", "warp.py", _RETURN, "return bilinear(color, taps(at)), ~leads_inside(at)"
    ),
    _warp("nan_inside", "non-finite motion is on screen", SAMPLE, _INSIDE, "return across & down", also=("holes",)),
    _warp(
        "nan_component",
        "only the non-finite component counts as 0",
        SAMPLE,
        _FOLLOW,
        "moved = np.where(np.isfinite(motion), motion, 0)",
        also=("occlusion_warp",),
    ),
    _warp(
        "nan_first_pixel",
        "non-finite motion, clamped, is the first pixel",
        SAMPLE,
        _FOLLOW,
        "moved = np.where(finite[..., None], motion, -1e9)",
        also=("occlusion_warp",),
    ),
    _warp(
        "lerp_of_products",
        "a (1 - t) + b t: a flat image is no longer flat",
        SAMPLE,
        "top = nw + (ne - nw) * fx",
        "top = nw * (1 - fx) + ne * fx",
        bits=True,
    ),
    _warp("fractions_swapped", "fx for fy", SAMPLE, _FRACTIONS, "fx, fy = at.fy[..., None], at.fx[..., None]", also=BOTH),
    _warp(
        "nearest",
        "the nearest pixel",
        SAMPLE,
        _FRACTIONS,
        "fx, fy = np.round(at.fx[..., None]), np.round(at.fy[..., None])",
        also=BOTH,
    ),
    _warp(
        "texture_fraction",
        "a texture sampler, whose fraction has 8 bits",
        SAMPLE,
        _FRACTIONS,
        "fx, fy = np.floor(at.fx[..., None] * 256) / 256, np.floor(at.fy[..., None] * 256) / 256",
        also=("occlusion_warp",),
    ),
    _warp(
        "half_position",
        "positions in half precision",
        SAMPLE,
        _FOLLOW,
        _summed("(p + moved).astype(np.float16)"),
        also=("occlusion_warp",),
    ),
    _warp("bgr", "colours in reverse", "warp.py", "return bilinear(color,", "return bilinear(color[..., ::-1],"),
    _warp(
        "four_channels",
        "channels from the fifth on stay 0",
        "warp.py",
        _RETURN,
        "warped = bilinear(color, taps(at))\n    warped[..., 4:] = 0\n    return warped, leads_inside(at)",
    ),
    _warp(
        "tail_of_row",
        "the last pixels of a row stay 0 where W is no multiple of 4",
        "warp.py",
        _RETURN,
        "warped = bilinear(color, taps(at))\n    warped[:, motion.shape[1] // 4 * 4 :] = 0\n    return warped, leads_inside(at)",
    ),
    _warp(
        "tile_seam",
        "the first row of every other tile of 8 reads one row above",
        "warp.py",
        "at = follow(motion)",
        "at = follow(motion)\n    at.y[8::16] -= 1",
    ),
)
