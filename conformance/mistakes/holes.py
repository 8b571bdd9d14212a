# SPDX-License-Identifier: MIT
"""Mistakes in stages holes, occlusion_warp and rrm."""

from collections.abc import Sequence

from conformance.mistakes.variants import Change, Mistake, fault

FILE = "holes.py"
_FOLLOW = "place = follow(motion)"
_AT = "at = taps(place)"
_STATIC = "static = (s == 0) & ~near"
_NEAR = "near = _squared(between(offsets, at)) <= limits.footprints**2 * squared_footprint(position)"
_PAPER = "near = _largest_distance(offsets) <= bias"
_FOOTPRINT = "return _nearer(position, axis=1) + _nearer(position, axis=0)"
_NEAREST = "nearest = np.minimum(before, after)"
_DISTANCE = "return np.sqrt(_squared(np.stack(offsets))).max(axis=0)"
_OFFSET = "position_previous[j, i] - position for j"
_ROWS = "for j in (at.y0, at.y1) for i in (at.x0, at.x1)"
_COSINE = "cosine = (normal * n).sum(axis=-1) / (length + length.dtype.type(1e-5))"
_BIAS = "limits.facing * facing + limits.grazing * (1 - facing) + limits.depth * depth"
_SURFACE = "surface = (length > 0) | (normal != 0).any(axis=-1)"
_UNION = "return leads_inside(place) & ~static & ~moving & ~mesh"
_STENCIL = "s = bilinear(stencil_previous[..., None], at)[..., 0]"
_LENGTH = "length = np.sqrt((n * n).sum(axis=-1))"


def _holes(name: str, what: str, *change: str, more: Sequence[Change] = ()) -> Mistake:
    return fault("holes", name, what, FILE, *change, more=more)


def _limit(name: str, what: str, *change: str) -> Mistake:
    return fault("holes", name, what, "constants.py", *change)


HOLES = (
    _holes("axes_swapped", "takes dx for dy", _FOLLOW, "place = follow(motion[..., ::-1])"),
    _holes("not_followed", "reads the earlier buffers at p", _AT, "at = taps(follow(motion * 0))"),
    _holes(
        "stencil_of_8_bits",
        "stencils in 8 bits",
        _FOLLOW,
        f"{_FOLLOW}\n    stencil, stencil_previous = stencil % 256, stencil_previous % 256",
    ),
    _holes(
        "stencil_of_16_bits",
        "stencils in 16 bits",
        _FOLLOW,
        f"{_FOLLOW}\n    stencil, stencil_previous = stencil % 65536, stencil_previous % 65536",
    ),
    _holes("inverted", "1 in the holes", _UNION, "return ~(leads_inside(place) & ~static & ~moving & ~mesh)"),
    _holes("off_screen_missing", "off screen is no hole", _UNION, "return ~static & ~moving & ~mesh"),
    _holes("static_missing", "no test of static geometry", _UNION, "return leads_inside(place) & ~moving & ~mesh"),
    _holes("moving_missing", "no test of moving objects", _UNION, "return leads_inside(place) & ~static & ~mesh"),
    _holes("mesh_missing", "no test of the object", _UNION, "return leads_inside(place) & ~static & ~moving"),
    _holes("nov_signed", "NoV for |NoV|", "facing = np.abs(nov)", "facing = nov"),
    _holes("nov_clamped", "max(NoV, 0) for |NoV|", "facing = np.abs(nov)", "facing = np.maximum(nov, 0)"),
    _holes(
        "nov_reversed",
        "45 cm head-on, 7.5 cm edge-on",
        _BIAS,
        "limits.grazing * facing + limits.facing * (1 - facing) + limits.depth * depth",
    ),
    _limit("footprints_1", "1 footprint for 1.5", "footprints: float = 1.5", "footprints: float = 1.0"),
    _holes("footprints_once", "1.5 for 1.5 * 1.5 beside squares", "limits.footprints**2", "limits.footprints"),
    _holes(
        "footprint_of_the_farther",
        "the farther neighbour",
        _NEAREST,
        "nearest = np.where(before < np.inf, before, 0)\n    nearest = np.maximum(nearest, np.where(after < np.inf, after, 0))",
    ),
    _holes("footprint_to_the_right", "the right and the lower neighbour", _NEAREST, "nearest = after"),
    _holes("footprint_across", "neighbours in the row alone", _FOOTPRINT, "return _nearer(position, axis=1)"),
    _holes(
        "footprint_of_the_longer_axis",
        "the longer of the two axes for both",
        _FOOTPRINT,
        _FOOTPRINT.replace("return _nearer(position, axis=1) + ", "return np.maximum(_nearer(position, axis=1), ") + ")",
    ),
    _holes(
        "footprint_before",
        "the footprint in the earlier frame, there",
        "squared_footprint(position)",
        "squared_footprint(position_previous)[at.y0, at.x0]",
    ),
    _holes("footprint_beyond", "beyond the frame nothing is 0 apart", "constant_values=np.inf", "constant_values=0.0"),
    _holes(
        "footprint_infinite",
        "without a neighbour nothing is far",
        "return np.where(nearest < np.inf, nearest, 0)",
        "return nearest",
    ),
    _holes("offset_of_one", "the offset of the first of four", "_squared(between(offsets, at))", "_squared(offsets[0])"),
    _holes(
        "offset_of_the_farthest",
        "the largest of four offsets",
        "_squared(between(offsets, at))",
        "_squared(np.stack(offsets)).max(axis=0)",
    ),
    _holes("paper_forgotten", "never the paper's test", 'if test == "paper":', "if False:"),
    _holes("paper_always", "always the paper's test", 'if test == "paper":', "if True:"),
    _limit("facing_5", "5 cm for 7.5 cm", "facing: float = 7.5", "facing: float = 5.0"),
    _limit("grazing_40", "40 cm for 45 cm", "grazing: float = 45.0", "grazing: float = 40.0"),
    _limit("depth_missing", "no term of the depth", "depth: float = 50.0", "depth: float = 0.0"),
    _holes("depth_reversed", "1 - depth for depth", "limits.depth * depth", "limits.depth * (1 - depth)"),
    _limit("cosine_95", "cosine 0.95 for 0.98", "cosine: float = 0.98", "cosine: float = 0.95"),
    _holes("mesh_once", "stencils' difference taken once, not three times", "3 * np.abs(s - stencil)", "np.abs(s - stencil)"),
    _holes("mesh_signed", "only a larger earlier stencil is another object", "3 * np.abs(s - stencil)", "3 * (s - stencil)"),
    _holes("metres", "the paper's distances in metres", _DISTANCE, f"{_DISTANCE} / 100"),
    _holes("nearest_distance", "the smallest of four distances", _DISTANCE, _DISTANCE.replace(".max", ".min")),
    _holes("mean_distance", "the mean of four distances", _DISTANCE, _DISTANCE.replace(".max", ".mean")),
    _holes("first_distance", "the first of four taps", _DISTANCE, _DISTANCE.replace(".max(axis=0)", "[0]")),
    _holes(
        "interpolated_position",
        "interpolates the positions, then one distance",
        _PAPER,
        "near = np.sqrt(_squared(between(offsets, at))) <= bias",
    ),
    _holes(
        "weightless_taps_left_out",
        "taps of weight 0 do not count",
        _ROWS,
        "for j in (at.y0, np.where(at.fy > 0, at.y1, at.y0)) for i in (at.x0, np.where(at.fx > 0, at.x1, at.x0))",
    ),
    fault(
        "holes",
        "last_tap_wraps",
        "the tap right of the frame is its first column",
        "sample.py",
        "np.minimum(x0 + 1, width - 1), ",
        "(x0 + 1) % width, ",
    ),
    _holes("squared_distance", "squared distances", _DISTANCE, "return _squared(np.stack(offsets)).max(axis=0)"),
    _holes("sum_of_absolutes", "|dx| + |dy| + |dz|", _DISTANCE, "return np.abs(np.stack(offsets)).sum(axis=-1).max(axis=0)"),
    _holes(
        "half_position",
        "positions in half precision",
        _OFFSET,
        "(position_previous[j, i].astype(np.float16) - position.astype(np.float16)).astype(position.dtype) for j",
    ),
    _holes(
        "position_there", "compares with this frame's position there", _OFFSET, "position_previous[j, i] - position[j, i] for j"
    ),
    _holes(
        "nan_trusted", "d > 1.5 footprints: false for NaN", _NEAR, _NEAR.replace("near = ", "near = ~(").replace("<=", ">") + ")"
    ),
    _holes("nan_dropped", "a maximum that drops NaN", _DISTANCE, "return np.fmax.reduce(np.sqrt(_squared(np.stack(offsets))))"),
    _holes("static_everywhere", "distance tested on moving objects too", _STATIC, _STATIC.replace("(s == 0) & ", "")),
    _holes("static_by_current", "static by the current stencil", _STATIC, _STATIC.replace("s == 0", "stencil == 0")),
    _holes("moving_everywhere", "normals tested on static geometry too", "moving = (s != 0) & ", "moving = "),
    _holes(
        "stencil_nearest",
        "the nearest earlier stencil",
        _STENCIL,
        "s = stencil_previous[np.where(at.fy < 0.5, at.y0, at.y1), np.where(at.fx < 0.5, at.x0, at.x1)]",
    ),
    _holes(
        "stencil_here",
        "the current stencil in the place of the earlier one",
        _STENCIL,
        "s = bilinear(stencil[..., None], at)[..., 0]",
    ),
    _holes(
        "normal_here",
        "the current normal in the place of the earlier one",
        "n = bilinear(normal_previous, at)",
        "n = bilinear(normal, at)",
    ),
    _holes(
        "length_of_current", "divides by the current normal's length", _LENGTH, "length = np.sqrt((normal * normal).sum(axis=-1))"
    ),
    _holes("length_of_both", "divides by both normals' lengths", _COSINE, f"{_COSINE} / np.sqrt((normal * normal).sum(axis=-1))"),
    _holes("length_missing", "does not divide by the length", _COSINE, "cosine = (normal * n).sum(axis=-1)"),
    _holes(
        "epsilon_missing", "no 1e-5 beside the length: no normal, no hole", _COSINE, "cosine = (normal * n).sum(axis=-1) / length"
    ),
    _holes(
        "cosine_absolute",
        "|cos|: a surface turned round is the same",
        _COSINE,
        _COSINE.replace("(normal * n).sum(axis=-1)", "np.abs((normal * n).sum(axis=-1))"),
    ),
    _holes("background_moves", "two normals of length 0 are a hole", _SURFACE, "surface = np.True_"),
    _holes("one_normal", "one normal of length 0 is no hole", _SURFACE, _SURFACE.replace("|", "&")),
)

FILL = "occlusion_warp.py"
_ORDER = 'np.argsort(np.where(writes, depth, np.inf), axis=None, kind="stable")[: writes.sum()][::-1]'
_KEY = "np.where(writes, depth, np.inf), axis=None"
_LOOKUP = "lookup = taps(follow(motion))"
_MAP = "splat(motion, depth)[lookup.y0, lookup.x0]"
_CORNER = "at.x.ravel()"
_RIGHT, _BELOW = "+ (0, 1, 0, 1)", "+ (0, 0, 1, 1)"
_LANDS = "lands = (x0 >= 0) & (x0 < width) & (y0 >= 0) & (y0 < height)"
_WRITE = "motion.reshape(-1, 2)"
_FILLED = "np.where(valid.astype(bool)[..., None], warped, instead)"
_AGAIN = "bilinear(color, taps(follow(occlusion_motion)))"


def _fill(name: str, what: str, *change: str, more: Sequence[Change] = ()) -> Mistake:
    return fault("occlusion_warp", name, what, FILL, *change, more=more)


OCCLUSION_WARP = (
    _fill(
        "last_of_equals",
        "<= for <: the last of equal depths stays",
        _ORDER,
        "np.lexsort((-np.arange(depth.size), np.where(writes, depth, np.inf).ravel()))[: writes.sum()][::-1]",
    ),
    _fill("farthest", "the farthest surface stays", _KEY, "np.where(writes, -depth, np.inf), axis=None"),
    _fill("last_written", "no depth test", _ORDER, "np.flatnonzero(writes)"),
    _fill("first_written", "no depth test, the first one stays", _ORDER, "np.flatnonzero(writes)[::-1]"),
    _fill("depth_of_8_bits", "depth in 8 bits", _KEY, "np.where(writes, np.floor(depth * 255), np.inf), axis=None"),
    _fill("half_depth", "depth in half precision", _KEY, "np.where(writes, depth.astype(np.float16), np.inf), axis=None"),
    _fill(
        "minus_zero", "depth by its bits: -0 is the farthest", _KEY, "np.where(writes, depth, -np.inf).view(np.uint32), axis=None"
    ),
    _fill("starts_at_1", "the depth buffer starts at 1: a background at 1 does not splat", "FARTHEST = 10.0", "FARTHEST = 1.0"),
    _fill("one_pixel", "writes one pixel of four", _RIGHT, "+ (0, 0, 0, 0)", more=[(FILL, _BELOW, "+ (0, 0, 0, 0)")]),
    _fill(
        "weighted_pixels",
        "whole-pixel motion writes no right neighbour",
        _RIGHT,
        f"{_RIGHT} * (at.fx > 0).ravel()[order, None]",
    ),
    _fill("truncated_splat", "trunc for floor in the splat", _CORNER, "(at.x + ((at.x < 0) & (at.fx > 0))).ravel()"),
    _fill("rounded_splat", "splats around the nearest pixel", _CORNER, "(at.x + (at.fx >= 0.5)).ravel()"),
    _fill("rounded_lookup", "looks up the nearest pixel", _LOOKUP, "lookup = taps(follow(np.rint(motion)))"),
    _fill(
        "corner_must_land",
        "drops all four where the first is outside",
        _LANDS,
        "lands = (x0[:, :1] >= 0) & (x0 < width) & (y0[:, :1] >= 0) & (y0 < height)",
    ),
    _fill(
        "unwritten_keep_motion",
        "nobody wrote: the motion there, not 0",
        "np.zeros_like(motion)",
        "np.where(np.isfinite(motion), motion, 0)",
    ),
    _fill(
        "half_motion", "moves motion in half precision", _WRITE, "motion.astype(np.float16).astype(motion.dtype).reshape(-1, 2)"
    ),
    _fill("looked_up_here", "looks up the pixel itself", _MAP, "splat(motion, depth)"),
    _fill(
        "interpolated_lookup",
        "interpolates the splatted map",
        _MAP,
        "bilinear(splat(motion, depth), lookup)",
    ),
    _fill(
        "outside_looks_up_0",
        "off screen looks up 0, not the border",
        _MAP,
        f"{_MAP} * leads_inside(follow(motion))[..., None]",
        more=[(FILL, "bilinear, follow, taps\n", "bilinear, follow, leads_inside, taps\n")],
    ),
    _fill(
        "read_from_lookup",
        "the new motion starts at the place of the lookup",
        _AGAIN,
        _AGAIN.replace("(occlusion_motion)", "(motion + occlusion_motion)"),
    ),
    _fill(
        "second_sign", "the new motion with the other sign", _AGAIN, _AGAIN.replace("(occlusion_motion)", "(-occlusion_motion)")
    ),
    _fill(
        "nan_splats",
        "non-finite motion splats as 0",
        "writes = at.finite & ",
        "writes = ",
        more=[(FILL, _WRITE, "np.where(np.isfinite(motion).all(axis=-1)[..., None], motion, 0).reshape(-1, 2)")],
    ),
    _fill("unfilled", "holes are left as they are", _FILLED, "warped"),
    _fill("filled_everywhere", "fills what needs no filling", _FILLED, "instead"),
    _fill("valid_inverted", "fills all but the holes", _FILLED, _FILLED.replace("warped, instead", "instead, warped")),
)

_MASKED = "masked[y : y + h, x : x + w] = 0"


def _rrm(name: str, what: str, new: str, old: str = _MASKED) -> Mistake:
    return fault("rrm", name, what, "rrm.py", old, new)


RRM = (
    _rrm("axes_swapped", "x first", "masked[x : x + w, y : y + h] = 0"),
    _rrm("sides_swapped", "width before height", "masked[y : y + w, x : x + h] = 0"),
    _rrm("corners", "two corners, not corner and size", "masked[y:h, x:w] = 0"),
    _rrm("one_more", "the end included", "masked[y : y + h + 1, x : x + w + 1] = 0"),
    _rrm("one_less", "without the last row", "masked[y : y + h - 1, x : x + w] = 0"),
    _rrm("from_1", "counts from 1", "masked[max(y - 1, 0) : max(y + h - 1, 0), x : x + w] = 0"),
    _rrm("filled", "1 in the rectangle", "masked[y : y + h, x : x + w] = 1"),
    _rrm("outside", "0 outside the rectangle", "masked[:y] = masked[y + h :] = 0\n    masked[:, :x] = masked[:, x + w :] = 0"),
    _rrm("toggled", "holes in the rectangle become valid", "masked[y : y + h, x : x + w] ^= 1"),
    _rrm("holes_forgotten", "valid but for the rectangle", "masked = np.ones_like(valid)", "masked = valid.copy()"),
)
