# SPDX-License-Identifier: MIT
"""Planted faults: motion_chain and warp, and what warp shares with holes and occlusion_warp."""

from tests.meta.variants import fault

BOTH = ("holes", "occlusion_warp")
CHAIN = "motion_chain.py"
SAMPLE = "sample.py"

_POSITION = "x, y = x + chained[..., 0], y + chained[..., 1]"
_HALF_POSITION = """x, y = x + chained[..., 0], y + chained[..., 1]
    with np.errstate(all="ignore"):
        x, y = (c.astype(np.float16).astype(c.dtype) for c in (x, y))"""
_SQUARES = "length = (corners * corners).sum(axis=-1)"
_DEFAULT = "def motion_chain(motions: Image, gather: Gather = "
_STILL = "still = (corners == 0).all(axis=-1).any(axis=0)"
_OVER = "for earlier in motions[1:]:"
_STEP = "chained = chained + GATHERS[gather](earlier, chained)"


def _chain(name, what, *change, more=()):
    return fault("motion_chain", name, what, CHAIN, *change, more=more)


MOTION_CHAIN = (
    _chain("x_sign", "follows x to the other side", _POSITION, "x, y = x - chained[..., 0], y + chained[..., 1]"),
    _chain("y_sign", "follows y to the other side", _POSITION, "x, y = x + chained[..., 0], y - chained[..., 1]"),
    _chain("axes_swapped", "takes dx for dy", _POSITION, "x, y = x + chained[..., 1], y + chained[..., 0]"),
    _chain("not_followed", "adds the motions of one pixel", _POSITION, ""),
    _chain("half_position", "positions in half precision", _POSITION, _HALF_POSITION),
    _chain("floor", "floor for trunc, left of the frame and above it", "np.trunc(c)", "np.floor(c)"),
    _chain("half_pixel", "pixel centres at halves", "np.trunc(c)", "np.trunc(c + c.dtype.type(0.5))"),
    _chain(
        "truncated_motion",
        "truncates the motion, not the position",
        _POSITION,
        "x, y = x + np.trunc(chained[..., 0]), y + np.trunc(chained[..., 1])",
    ),
    _chain("shortest", "the shortest of four", "length.argmax(axis=0)", "length.argmin(axis=0)"),
    _chain("first", "the first of four, not the longest", "length.argmax(axis=0)", "np.zeros(length.shape[1:], np.intp)"),
    _chain("last_of_equals", "the last of equally long ones", "length.argmax(axis=0)", "(3 - length[::-1].argmax(axis=0))"),
    _chain("sum_of_absolutes", "length as |dx| + |dy|", _SQUARES, "length = np.abs(corners).sum(axis=-1)"),
    _chain("zero_ignored", "a still one among the four does not win", _STILL, "still = np.False_"),
    _chain("zero_component", "dx = 0 alone counts as still", _STILL, "still = (corners == 0).any(axis=-1).any(axis=0)"),
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
        "return np.where(near, x, -2), np.where(near, y, -2)",
        "return np.where(near, x, 0), np.where(near, y, 0)",
    ),
    _chain("last_column_outside", "column W - 1 is outside", "(x < width) & (y >= 0)", "(x < width - 1) & (y >= 0)"),
    _chain("nan_loses", "a non-finite motion is the shortest", ".all(axis=-1), length, np.inf)", ".all(axis=-1), length, -1)"),
    _chain("nearest", "the nearest pixel's motion", f'{_DEFAULT}"longest"', f'{_DEFAULT}"nearest"'),
    _chain("bilinear", "interpolates motion", f'{_DEFAULT}"longest"', f'{_DEFAULT}"bilinear"'),
)

_FOLLOW = "x, y = x + np.where(finite, motion[..., 0], 0), y + np.where(finite, motion[..., 1], 0)"
_CLAMP = "x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)"
_INSIDE = "inside = finite & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)"
_RETURN = "return bilinear(color, taps(x, y)), inside"
_FRACTIONS = "fx, fy = at.fx[..., None], at.fy[..., None]"
_WRAPPED_TAP = (SAMPLE, "np.minimum(x0 + 1, width - 1), ", "(x0 + 1) % width, ")
_HALF_CLAMP = f"x, y = (c.astype(np.float16).astype(c.dtype) for c in (x, y))\n    {_CLAMP}"


def _warp(name, what, *change, **marks):
    return fault("warp", name, what, *change, **marks)


WARP = (
    _warp("x_sign", "x to the left", SAMPLE, _FOLLOW, _FOLLOW.replace("x + ", "x - "), also=BOTH),
    _warp("y_sign", "y upwards", SAMPLE, _FOLLOW, _FOLLOW.replace("y + ", "y - "), also=BOTH),
    _warp(
        "axes_swapped",
        "takes dx for dy",
        SAMPLE,
        _FOLLOW,
        "x, y = x + np.where(finite, motion[..., 1], 0), y + np.where(finite, motion[..., 0], 0)",
        also=BOTH,
    ),
    _warp("half_pixel", "pixel centres at halves", SAMPLE, _CLAMP, f"x, y = x - 0.5, y - 0.5\n    {_CLAMP}", also=BOTH),
    _warp(
        "corners_grid",
        "normalises with corners aligned, samples with centres aligned",
        SAMPLE,
        _CLAMP,
        f"x, y = x * (width / max(width - 1, 1)) - 0.5, y * (height / max(height - 1, 1)) - 0.5\n    {_CLAMP}",
        also=BOTH,
    ),
    _warp(
        "border_wraps",
        "outside the frame its other side",
        SAMPLE,
        _CLAMP,
        "x, y = np.clip(np.mod(x, width), 0, width - 1), np.clip(np.mod(y, height), 0, height - 1)",
        also=("occlusion_warp",),
    ),
    _warp(
        "border_mirrored",
        "outside the frame its mirror image",
        SAMPLE,
        _CLAMP,
        "x, y = np.clip(np.abs(x), 0, width - 1), np.clip(np.abs(y), 0, height - 1)",
        also=("occlusion_warp",),
    ),
    _warp(
        "border_black",
        "0 outside the frame",
        "warp.py",
        _RETURN,
        "return bilinear(color, taps(x, y)) * inside[..., None], inside",
    ),
    _warp(
        "fraction_unclamped",
        "clamps the pixels, keeps the fraction of the position",
        SAMPLE,
        _CLAMP,
        f"fx, fy = x - np.floor(x), y - np.floor(y)\n    {_CLAMP}",
        more=[(SAMPLE, "y1, x - np.floor(x), y - np.floor(y))", "y1, fx, fy)")],
        also=("occlusion_warp",),
    ),
    _warp(
        "clamped_to_width",
        "clamps x to W, not W - 1: the last column blends into the next row",
        SAMPLE,
        _CLAMP,
        "x, y = np.clip(x, 0, width - 2.0**-6), np.clip(y, 0, height - 1)",
        more=[_WRAPPED_TAP],
        also=("occlusion_warp",),
    ),
    _warp(
        "last_column_unread",
        "clamps x to W - 2, where two pixels still fit",
        SAMPLE,
        _CLAMP,
        "x, y = np.clip(x, 0, max(width - 2, 0)), np.clip(y, 0, height - 1)",
        also=BOTH,
    ),
    _warp("inside_to_width", "between W - 1 and W is inside", SAMPLE, "(x <= width - 1)", "(x < width)", also=("holes",)),
    _warp(
        "inside_without_zero",
        "x = 0 is outside",
        SAMPLE,
        "inside = finite & (x >= 0)",
        "inside = finite & (x > 0)",
        also=("holes",),
    ),
    _warp("inside_without_last", "row H - 1 is outside", SAMPLE, "(y <= height - 1)", "(y < height - 1)", also=("holes",)),
    _warp("inside_x_only", "only x can be off screen", SAMPLE, "& (y >= 0) & (y <= height - 1)", "", also=("holes",)),
    _warp(
        "inside_sides_swapped",
        "tests x against the height",
        SAMPLE,
        "(x <= width - 1) & (y >= 0) & (y <= height - 1)",
        "(x <= height - 1) & (y >= 0) & (y <= width - 1)",
        also=("holes",),
    ),
    _warp("inside_clamped", "tests the position after clamping it", SAMPLE, _INSIDE, "inside = finite", also=("holes",)),
    _warp("inside_inverted", "1 where it is off screen", "warp.py", _RETURN, "return bilinear(color, taps(x, y)), ~inside"),
    _warp(
        "nan_inside", "non-finite motion is on screen", SAMPLE, "inside = finite & (x >= 0)", "inside = (x >= 0)", also=("holes",)
    ),
    _warp(
        "nan_component",
        "only the non-finite component counts as 0",
        SAMPLE,
        _FOLLOW,
        "x, y = (c + np.where(np.isfinite(motion[..., i]), motion[..., i], 0) for i, c in enumerate((x, y)))",
        also=("occlusion_warp",),
    ),
    _warp(
        "nan_first_pixel",
        "non-finite motion, clamped, is the first pixel",
        SAMPLE,
        _FOLLOW,
        "x, y = x + np.where(finite, motion[..., 0], -x), y + np.where(finite, motion[..., 1], -y)",
        also=("occlusion_warp",),
    ),
    _warp(
        "lerp_of_products",
        "a (1 - t) + b t: a flat image is no longer flat",
        SAMPLE,
        "top = image[at.y0, at.x0] + (image[at.y0, at.x1] - image[at.y0, at.x0]) * fx",
        "top = image[at.y0, at.x0] * (1 - fx) + image[at.y0, at.x1] * fx",
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
    _warp("half_position", "positions in half precision", SAMPLE, _CLAMP, _HALF_CLAMP, also=("occlusion_warp",)),
    _warp("bgr", "colours in reverse", "warp.py", "return bilinear(color,", "return bilinear(color[..., ::-1],"),
    _warp(
        "four_channels",
        "channels from the fifth on stay 0",
        "warp.py",
        _RETURN,
        "warped = bilinear(color, taps(x, y))\n    warped[..., 4:] = 0\n    return warped, inside",
    ),
    _warp(
        "tail_of_row",
        "the last pixels of a row stay 0 where W is no multiple of 4",
        "warp.py",
        _RETURN,
        "warped = bilinear(color, taps(x, y))\n    warped[:, motion.shape[1] // 4 * 4 :] = 0\n    return warped, inside",
    ),
    _warp(
        "tile_seam",
        "the first row of every other tile of 8 reads one row above",
        "warp.py",
        "x, y, inside = follow(motion)",
        "x, y, inside = follow(motion)\n    y[8::16] -= 1",
    ),
)
