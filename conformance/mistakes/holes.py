# SPDX-License-Identifier: MIT
"""Mistakes in stages holes, occlusion_warp and rrm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from conformance.protocol.reference_copy import Mistake, Plant, change_arguments, fault, half, put, returns, wrap
from stss_ref.constants import HoleLimits
from stss_ref.holes import nearer, neighbours
from stss_ref.sample import Place, Taps, between, bilinear, follow, leads_inside, taps

Change = Callable[..., Any]


def limits(**numbers: float) -> Plant:
    """Other constants of the hole test."""
    return put("constants.HoleLimits", lambda: HoleLimits(**numbers))


_holes = partial(fault, "holes")


def _takes(name: str, what: str, **changes: Change) -> Mistake:
    """The stage takes other inputs."""
    return _holes(name, what, change_arguments("holes.holes", **changes))


def _valid(name: str, what: str, change: Change) -> Mistake:
    return _holes(name, what, returns("holes.holes", change))


def _distance(name: str, what: str, change: Callable[[Any], Any]) -> Mistake:
    """The paper's distance is ``change`` of the four offsets, (4, H, W, 3)."""
    return _holes(name, what, put("holes.largest_distance", lambda four: change(np.stack(four))))


def _nearer(name: str, what: str, change: Callable[[Any, Any], Any]) -> Mistake:
    """``change`` of the squared distances to the neighbours before and after."""
    return _holes(name, what, put("holes.nearer", change))


def _cosine(name: str, what: str, change: Callable[[Any, Any, Any], Any]) -> Mistake:
    """The cosine is ``change`` of the dot product and the lengths of the earlier normal and of this one."""
    return _holes(
        name, what, put("holes.cosine", lambda normal, n: change((normal * n).sum(axis=-1), _length(n), _length(normal)))
    )


def _length(vectors: Any) -> Any:
    return np.sqrt((vectors * vectors).sum(axis=-1))


def _bits(bits: int) -> dict[str, Change]:
    return dict.fromkeys(("stencil", "stencil_previous"), lambda stencil: stencil % 2**bits)


def _half_stencil(stencil: Any) -> Any:
    """In half; the largest number for those beyond it, since an infinite stencil is refused."""
    return half(np.minimum(stencil, np.finfo(np.float16).max))


def _finite(distance: Any) -> Any:
    return np.where(distance < np.inf, distance, 0)


def _lost_neighbours(position: Any, axis: int) -> Any:
    """The distances to the neighbours; one that is lost counts, one beyond the frame does not."""
    apart = (np.diff(position, axis=axis) ** 2).sum(axis=-1)
    sides = (((1, 0), (0, 1)) if i == axis else ((0, 0), (0, 0)) for i in (0, 1))
    return tuple(np.pad(apart, side, constant_values=np.inf) for side in zip(*sides, strict=True))


def _everywhere(number: float) -> Change:
    """The stage's test of surfaces with this stencil, of all surfaces."""

    def wrong(holes: Change, motion: Any, **inputs: Any) -> Any:
        same = np.full_like(inputs["stencil"], number)
        return holes(motion, **inputs) & holes(motion, **{**inputs, "stencil": same, "stencil_previous": same})

    return wrong


def _weightless(at: Taps) -> Taps:
    return at._replace(x1=np.where(at.fx > 0, at.x1, at.x0), y1=np.where(at.fy > 0, at.y1, at.y0))


def _snorm(vectors: Any, bits: int) -> Any:
    most = 2 ** (bits - 1) - 1
    return (np.round(vectors * most) / most).astype(vectors.dtype)


def _of_quads(sides: tuple[Any, Any], axis: int) -> tuple[Any, Any]:
    before, after = sides
    odd = np.indices(before.shape)[axis] % 2 == 1
    return np.where(odd, before, np.inf), np.where(odd, np.inf, after)


NAN_DROPPED = put("holes.largest_distance", lambda four: np.fmax.reduce(_length(np.stack(four))))
NAN_TRUSTED = returns("holes.between", lambda offset: np.where(np.isnan(offset).any(axis=-1, keepdims=True), 0, offset))
NAN_NEAR = put(
    "holes.largest_distance", lambda four: np.nan_to_num(np.fmax.reduce(_length(np.stack(four))), nan=0, posinf=np.inf)
)


HOLES = (
    _holes("axes_swapped", "takes dx for dy", change_arguments("holes.follow", motion=lambda motion: motion[..., ::-1])),
    _holes("not_followed", "reads the earlier buffers at p", change_arguments("holes.follow", motion=lambda motion: motion * 0)),
    _takes("stencil_of_8_bits", "stencils in 8 bits", **_bits(8)),
    _takes("stencil_of_16_bits", "stencils in 16 bits", **_bits(16)),
    _takes("stencil_in_half", "stencils in half precision", **dict.fromkeys(("stencil", "stencil_previous"), _half_stencil)),
    _takes("stencil_here", "the current stencil in the place of the earlier one", stencil_previous=lambda _, stencil: stencil),
    _takes("normal_here", "the current normal in the place of the earlier one", normal_previous=lambda _, normal: normal),
    _takes("half_position", "positions in half precision", position=half, position_previous=half),
    _takes("paper_forgotten", "always the footprint's hole test", test=lambda _: "footprint"),
    _takes("paper_always", "always the paper's test", test=lambda _: "paper"),
    _takes("nov_clamped", "max(NoV, 0) for |NoV|", nov=lambda nov: np.maximum(nov, 0)),
    _takes("depth_reversed", "1 - depth for depth", depth=lambda depth: 1 - depth),
    _takes("depth_of_16_bits", "depth in 16 bits", depth=lambda depth: np.round(depth * 65535) / np.float32(65535)),
    *(
        _takes(
            f"normals_of_{bits}_bits",
            f"normals in {bits} bits",
            **dict.fromkeys(("normal", "normal_previous"), partial(_snorm, bits=bits)),
        )
        for bits in (8, 10)
    ),
    _takes("normals_in_half", "earlier normals in half precision", normal_previous=half),
    _valid("inverted", "1 in the holes", np.logical_not),
    _holes("off_screen_missing", "off screen is no hole", put("holes.leads_inside", lambda at: np.ones(at.x.shape, bool))),
    _holes(
        "static_missing",
        "no test of static geometry",
        put("holes.offsets", lambda _, position, __: [np.zeros_like(position)] * 4),
    ),
    _holes("moving_missing", "no test of moving objects", limits(cosine=-np.inf)),
    _holes("leaning_missing", "no test of static surfaces' normals", limits(static_cosine=-np.inf)),
    _holes("leaning_06", "cosine 0.6 for 0.5 of static surfaces", limits(static_cosine=0.6)),
    _holes("mesh_missing", "no test of the object", limits(mesh=np.inf)),
    _holes("static_everywhere", "distance tested on moving objects too", wrap("holes.holes", _everywhere(0))),
    _holes("moving_everywhere", "normals tested on static geometry too", wrap("holes.holes", _everywhere(1))),
    _holes(
        "nov_signed",
        "NoV for |NoV|",
        put("holes.bias", lambda nov, depth, limits: limits.facing * nov + limits.grazing * (1 - nov) + limits.depth * depth),
    ),
    _holes("nov_reversed", "45 cm head-on, 7.5 cm edge-on", limits(facing=45, grazing=7.5)),
    _holes("facing_5", "5 cm for 7.5 cm", limits(facing=5)),
    _holes("grazing_40", "40 cm for 45 cm", limits(grazing=40)),
    _holes("depth_missing", "no term of the depth", limits(depth=0)),
    _holes("cosine_95", "cosine 0.95 for 0.98", limits(cosine=0.95)),
    _holes("mesh_once", "stencils' difference taken once, not three times", limits(mesh=3)),
    _holes(
        "mesh_signed",
        "only a larger earlier stencil is another object",
        put("holes.objects_apart", lambda s, stencil: 3 * (s - stencil)),
    ),
    _holes("footprints_1", "1 footprint for 1.5", limits(footprints=1)),
    _holes("footprints_once", "1.5 for 1.5 * 1.5 beside squares", limits(footprints=1.5**0.5)),
    _nearer(
        "footprint_of_the_farther", "the farther neighbour", lambda before, after: np.maximum(_finite(before), _finite(after))
    ),
    _nearer("footprint_to_the_right", "the right and the lower neighbour", lambda _, after: _finite(after)),
    _holes(
        "footprint_of_quads",
        "neighbours within quads of 2 x 2, as ddx and ddy have them",
        returns("holes.neighbours", _of_quads),
    ),
    _nearer("footprint_infinite", "without a neighbour nothing is far", np.minimum),
    _holes(
        "footprint_across",
        "neighbours in the row alone",
        put("holes.squared_footprint", lambda position: nearer(*neighbours(position, 1))),
    ),
    _holes("footprint_lost", "a neighbour that is not finite counts", put("holes.neighbours", _lost_neighbours)),
    _holes("offset_of_one", "the offset of the first of four", put("holes.between", lambda four, at: four[0])),
    _distance("metres", "the paper's distances in metres", lambda four: _length(four).max(axis=0) / 100),
    _distance("nearest_distance", "the smallest of four distances", lambda four: _length(four).min(axis=0)),
    _distance("first_distance", "the first of four taps", lambda four: _length(four[0])),
    _distance("squared_distance", "squared distances", lambda four: (four * four).sum(axis=-1).max(axis=0)),
    _holes("nan_dropped", "a maximum that drops NaN", NAN_DROPPED),
    _holes(
        "interpolated_position",
        "interpolates the positions, then one distance",
        returns("holes.offsets", lambda four, at: [between(four, at)] * 4),
    ),
    _holes(
        "interpolated_first",
        "subtracts interpolated positions, for differences interpolated",
        put("holes.offsets", lambda previous, position, at: [bilinear(previous, at) - position] * 4),
    ),
    _holes(
        "paper_is_1",
        "the paper's test where paper is 1 alone",
        put("stages.hole_test", lambda paper: "paper" if paper[0] == 1 else "footprint"),
    ),
    _holes("weightless_taps_left_out", "taps of weight 0 do not count", change_arguments("holes.offsets", at=_weightless)),
    _holes(
        "last_tap_wraps",
        "the tap right of the frame is its first column",
        returns("holes.taps", lambda four, at: four._replace(x1=(four.x0 + 1) % at.x.shape[1])),
    ),
    _holes("nan_trusted", "d > 1.5 footprints: false for NaN", NAN_TRUSTED),
    _holes("fast_math", "NaN is never far: d > limit, or a build with fast-math", NAN_TRUSTED, NAN_NEAR),
    _cosine("length_of_current", "divides by the current normal's length", lambda dot, _, now: dot / (now + 1e-5)),
    _cosine("length_missing", "does not divide by the length", lambda dot, _, __: dot),
    _cosine("epsilon_missing", "no 1e-5 beside the length: no normal, no hole", lambda dot, then, _: dot / then),
    _cosine("cosine_absolute", "|cos|: a surface turned round is the same", lambda dot, then, _: np.abs(dot) / (then + 1e-5)),
    _holes(
        "faint_is_background",
        "normals shorter than 1e-6 count as 0",
        put("holes.is_surface", lambda normal, n: (_length(n) > 1e-6) | (_length(normal) > 1e-6)),
    ),
    _holes("background_moves", "two normals of length 0 are a hole", put("holes.is_surface", lambda normal, n: np.True_)),
    _holes(
        "one_normal",
        "one normal of length 0 is no hole",
        put("holes.is_surface", lambda normal, n: (_length(n) > 0) & (normal != 0).any(axis=-1)),
    ),
)


_fill = partial(fault, "occlusion_warp")


def _looked_up(name: str, what: str, change: Change) -> Mistake:
    return _fill(name, what, returns("occlusion_warp.look_up", change))


def _pixels(name: str, what: str, change: Change) -> Mistake:
    """Other pixels of the four are written to."""
    return _fill(name, what, returns("occlusion_warp.written_pixels", change))


def _nearest(name: str, what: str, change: Callable[[Any], Any]) -> Mistake:
    """The surface of the smallest ``change`` of the depth stays."""
    return _fill(name, what, change_arguments("occlusion_warp.writing_order", depth=change))


def _order(name: str, what: str, change: Callable[[Any, Any], Any]) -> Mistake:
    return _fill(name, what, put("occlusion_warp.writing_order", change))


def _writes(name: str, what: str, change: Callable[[Place], Any]) -> Mistake:
    """The pixels around another place are written to."""
    return _fill(name, what, change_arguments("occlusion_warp.written_pixels", at=change))


def _last_of_equals(depth: Any, writes: Any) -> Any:
    return np.lexsort((-np.arange(depth.size), np.where(writes, depth, np.inf).ravel()))[: writes.sum()][::-1]


def _if_first_lands(pixels: tuple[Any, Any], at: Place) -> tuple[Any, Any]:
    (x, y), (height, width) = pixels, at.x.shape
    first = (x[:, :1] >= 0) & (x[:, :1] < width) & (y[:, :1] >= 0) & (y[:, :1] < height)
    return np.where(first, x, -1), y


def _where_it_moves(pixels: tuple[Any, Any], at: Place, order: Any) -> tuple[Any, Any]:
    x, y = pixels
    return np.where((at.fx > 0).ravel()[order, None], x, x[:, :1]), y


def _where_it_weighs(pixels: tuple[Any, Any], at: Place, order: Any) -> tuple[Any, Any]:
    x, y = pixels
    return (
        np.where((at.fx > 0).ravel()[order, None], x, x[:, :1]),
        np.where((at.fy > 0).ravel()[order, None], y, y[:, :1]),
    )


OCCLUSION_WARP = (
    _order("last_of_equals", "<= for <: the last of equal depths stays", _last_of_equals),
    _order("last_written", "no depth test", lambda _, writes: np.flatnonzero(writes)),
    _order("first_written", "no depth test, the first one stays", lambda _, writes: np.flatnonzero(writes)[::-1]),
    _nearest("farthest", "the farthest surface stays", np.negative),
    _nearest("depth_of_8_bits", "depth in 8 bits", lambda depth: np.floor(depth * 255)),
    _nearest("depth_of_24_bits", "depth in 24 bits", lambda depth: np.floor(depth.astype(np.float64) * (2**24 - 1))),
    _nearest("depth_of_16_bits", "depth in 16 bits", lambda depth: np.round(depth * 65535)),
    _nearest("half_depth", "depth in half precision", half),
    _nearest("minus_zero", "depth by its bits: -0 is the farthest", lambda depth: np.where(np.signbit(depth), 99, depth)),
    _nearest("minus_zero_nearer", "-0 is nearer than 0", lambda depth: np.where(np.signbit(depth), -1, depth)),
    _fill("starts_at_1", "the depth buffer starts at 1: a background at 1 does not splat", put("occlusion_warp.FARTHEST", 1.0)),
    _pixels("one_pixel", "writes one pixel of four", lambda xy: (xy[0][:, :1], xy[1][:, :1])),
    _pixels("weighted_pixels", "whole-pixel motion writes no right neighbour", _where_it_moves),
    _pixels("weightless_pixels", "whole-pixel motion writes no right and no lower neighbour", _where_it_weighs),
    _pixels("corner_must_land", "drops all four where the first is outside", _if_first_lands),
    _writes("truncated_splat", "trunc for floor in the splat", lambda at: at._replace(x=at.x + ((at.x < 0) & (at.fx > 0)))),
    _writes("rounded_splat", "splats around the nearest pixel", lambda at: at._replace(x=at.x + (at.fx >= 0.5))),
    _fill("rounded_lookup", "looks up the nearest pixel", change_arguments("occlusion_warp.look_up", motion=np.rint)),
    _fill("looked_up_here", "looks up the pixel itself", put("occlusion_warp.look_up", lambda earlier, _: earlier)),
    _looked_up(
        "interpolated_lookup", "interpolates the splatted map", lambda _, earlier, motion: bilinear(earlier, taps(follow(motion)))
    ),
    _looked_up(
        "outside_looks_up_0",
        "off screen looks up 0, not the border",
        lambda result, motion: result * leads_inside(follow(motion))[..., None],
    ),
    _fill("half_motion", "moves motion in half precision", returns("occlusion_warp.splat", half)),
    _fill(
        "nan_splats",
        "non-finite motion splats as 0",
        change_arguments(
            "occlusion_warp.splat", motion=lambda motion: np.where(np.isfinite(motion).all(axis=-1)[..., None], motion, 0)
        ),
    ),
    _looked_up("added_to_motion", "the new motion added to the one before", lambda result, motion: result + motion),
    _fill("second_sign", "the new motion with the other sign", change_arguments("occlusion_warp.read_along", motion=np.negative)),
    _fill("unfilled", "holes are left as they are", change_arguments("occlusion_warp.occlusion_warp", valid=np.ones_like)),
    _fill("filled_everywhere", "fills valid pixels, too", change_arguments("occlusion_warp.occlusion_warp", valid=np.zeros_like)),
    _fill("valid_inverted", "fills all but the holes", change_arguments("occlusion_warp.occlusion_warp", valid=np.logical_not)),
    _fill(
        "raster_65535",
        "a raster index of 16 bits in the splat",
        returns("occlusion_warp.writing_order", lambda order: order % 65536),
        large=True,
    ),
)


def _rrm(name: str, what: str, change: Callable[..., Any], value: int = 0) -> Mistake:
    """The pixels ``change(y, x, h, w)`` of the mask become ``value``."""

    def wrong(valid: Any, rectangle: Sequence[int]) -> Any:
        masked = valid.copy()
        masked[change(*rectangle)] = value
        return masked

    return fault("rrm", name, what, put("rrm.rrm", wrong))


RRM = (
    _rrm("axes_swapped", "x first", lambda y, x, h, w: np.s_[x : x + w, y : y + h]),
    _rrm("sides_swapped", "width before height", lambda y, x, h, w: np.s_[y : y + w, x : x + h]),
    _rrm("corners", "two corners, not corner and size", lambda y, x, h, w: np.s_[y:h, x:w]),
    _rrm("one_more", "the end included", lambda y, x, h, w: np.s_[y : y + h + 1, x : x + w + 1]),
    _rrm("one_less", "without the last row", lambda y, x, h, w: np.s_[y : y + h - 1, x : x + w]),
    _rrm("from_1", "counts from 1", lambda y, x, h, w: np.s_[max(y - 1, 0) : max(y + h - 1, 0), x : x + w]),
    _rrm("filled", "1 in the rectangle", lambda y, x, h, w: np.s_[y : y + h, x : x + w], 1),
    fault("rrm", "outside", "0 outside the rectangle", returns("rrm.rrm", lambda masked, valid: valid ^ masked)),
    fault("rrm", "holes_forgotten", "valid but for the rectangle", change_arguments("rrm.rrm", valid=np.ones_like)),
)
