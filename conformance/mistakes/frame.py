# SPDX-License-Identifier: MIT
"""Mistakes in stage frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from conformance.protocol.reference_copy import Copy, Mistake, Plant, change_arguments, fault, half, put, returns, wrap
from stss_ref.detail import PLACE
from stss_ref.frame import is_missing, stack_history
from stss_ref.motion_chain import gather_nearest, motion_chain
from stss_ref.sample import follow, leads_inside

Change = Callable[..., Any]


_frame = partial(fault, "frame")


def _steps(name: str, what: str, by: int) -> Mistake:
    """Motions are chained over other steps."""

    def wrong(motions: Any, steps: Any) -> Any:
        return {step: motion_chain(motions[: step + by]) for step in steps if step > 0 and step + by > 0}

    return _frame(name, what, put("frame.motion_by_step", wrong))


def _motions(name: str, what: str, change: Change) -> Mistake:
    return _frame(name, what, change_arguments("frame.motion_by_step", motions=change))


def _other(where: str, name: str, what: str, buffer: str, change: Callable[[Any], Any]) -> Mistake:
    """A function is given the change of one buffer."""
    return _frame(
        name,
        what,
        change_arguments(f"frame.{where}", inputs=lambda inputs: replace(inputs, **{buffer: change(getattr(inputs, buffer))})),
    )


def _order(name: str, what: str, buffer: str, *order: int) -> Mistake:
    """Frames of one buffer are taken for others."""
    return _other("warp_one", name, what, buffer, lambda frames: frames[list(order)])


def _roughness_for_depth(gbuffer: Any) -> Any:
    return gbuffer[..., [0, 1, 2, 4, 4, 5, 6, 7, 8]]


def _depth(change: Change) -> Change:
    """A G-buffer with ``change`` of its depth."""
    return lambda gbuffer: np.concatenate([gbuffer[..., :3], change(gbuffer[..., 3:4]), gbuffer[..., 4:]], axis=-1)


def _of_16_bits(depth: Any) -> Any:
    return (np.round(depth * 65535) / 65535).astype(depth.dtype)


def _missing(inputs: Any, i: int) -> bool:
    return i > 0 and inputs.steps[i] == inputs.steps[i - 1]


def _prepared(name: str, what: str, **changes: Change) -> Mistake:
    """The network is given others; each change has what was prepared as its argument."""
    return _frame(
        name,
        what,
        returns("frame.prepare", lambda result: replace(result, **{key: change(result) for key, change in changes.items()})),
    )


def _or_0(vectors: Any) -> Any:
    return np.where(np.isfinite(vectors).all(axis=-1, keepdims=True), vectors, 0)


def _signed_history(warped: Any, valids: Any, change: Callable[[Any], Any] = np.positive) -> Any:
    """The history with ``change`` of the colours in place of colours of at least 0."""
    masks = stack_history(warped, valids)[..., 3:]
    return np.concatenate([np.stack([change(w) for w in warped[::-1]]), masks], axis=-1)


def _detail(name: str, what: str, plant: Plant) -> Mistake:
    return _frame(f"detail_{name}", what, plant)


def _warps(name: str, what: str, change: Change) -> Mistake:
    """The details are those of other frames: each is a colour, the motion to it, and its stencil; newest first."""
    return _detail(name, what, change_arguments("frame.detail", frames=change))


def _measures(name: str, what: str, *factors: float) -> Mistake:
    return _detail(name, what, returns("frame.detail", lambda result: result * np.asarray(factors, result.dtype)))


def _tents(name: str, what: str, weigh: Callable[[Any], Any]) -> Mistake:
    """The tap at or before a place and the next one weigh ``weigh`` of their distances from the two places of a pixel."""

    def wrong(fraction: Any) -> Any:
        places = np.stack([fraction - PLACE, fraction + PLACE])
        return weigh(np.abs(places)), weigh(np.abs(places - 1))

    return _detail(name, what, put("detail.tents", wrong))


def _not_in_holes(copy: Copy) -> None:
    """Samples count where the warped colour is to be trusted."""
    valids: dict[int, Any] = {}

    def warped(right: Change, inputs: Any, i: int, motion: Any, *test: Any) -> Any:
        result = right(inputs, i, motion, *test)
        if not is_missing(inputs.steps, i):
            valids[id(motion)] = result[1]
        return result

    def detail(right: Change, first: Any, stencil: Any, frames: Any) -> Any:
        return right(
            first, stencil, [(c, np.where(valids[id(m)][..., None], m, np.nan).astype(m.dtype), n) for c, m, n in frames]
        )

    wrap("frame.warp_one", warped)(copy)
    wrap("frame.detail", detail)(copy)


DETAILS = (
    _detail(
        "ignored",
        "the newest frame is the second colour, whatever the weights say",
        change_arguments("frame.prepare", second=lambda _: "newest"),
    ),
    _detail(
        "black",
        "a black image for weights that want detail",
        returns("frame.frame", lambda got, weights: (got[0] * (weights.second_color == "newest"), got[1])),
    ),
    _detail("not_in_holes", "samples count where the warped colour is to be trusted", _not_in_holes),
    _detail(
        "of_all_objects",
        "samples of other objects count, too",
        change_arguments("frame.detail", stencil=np.zeros_like, frames=lambda frames: [(c, m, n * 0) for c, m, n in frames]),
    ),
    _warps(
        "numbers_of_newest", "the newest's object numbers for all", lambda frames: [(c, m, frames[0][2]) for c, m, _ in frames]
    ),
    _warps("not_warped", "samples of all frames at the pixel's own place", lambda frames: [(c, m * 0, n) for c, m, n in frames]),
    _warps("newest_alone", "samples of one frame alone", lambda frames: frames[:1]),
    _warps("oldest_left_out", "no samples of the oldest frame", lambda frames: frames[:-1]),
    _warps("ef_only", "nothing within the pixels of an SF", lambda frames: frames if len(frames) == 3 else []),
    _warps("sf_only", "nothing within the pixels of an EF", lambda frames: [] if len(frames) == 3 else frames),
    _measures("mirrored", "the left quarters less the right", -1, 1, 1),
    _measures("upside_down", "the upper quarters less the lower", 1, -1, 1),
    _measures("whole", "differences of the quarters' sums, not half of them", 2, 2, 1),
    _measures("no_level", "no difference of the mean", 1, 1, 0),
    _detail("turned", "down before across", returns("frame.detail", lambda result: result[..., [1, 0, 2]])),
    _detail("up_from_0", "differences below 0 become 0", returns("frame.detail", lambda result: np.maximum(result, 0))),
    _detail("own_black", "the pixel's own first colour counts as black", change_arguments("frame.detail", first=np.zeros_like)),
    _tents("tent_of_a_pixel", "samples count up to a pixel away", lambda d: np.maximum(0, 1 - d)),
    _tents("nearest", "the nearest sample counts whole", lambda d: (d < 0.5) * np.ones_like(d)),
    _detail("half_a_pixel_apart", "places in the corners of the pixel", put("detail.PLACE", 0.5)),
    _detail("own_whole", "the pixel's own first colour weighs 1", put("detail.OWN", 1.0)),
    _detail("own_left_out", "the pixel's own first colour weighs next to nothing", put("detail.OWN", 1e-3)),
    _detail("luma_of_equal_shares", "luma as the mean of R, G and B", put("detail.LUMA", (1 / 3, 1 / 3, 1 / 3))),
    _detail("luma_709", "luma of Rec. 709", put("detail.LUMA", (0.2126, 0.7152, 0.0722))),
)


def _picture(name: str, what: str, **changes: Change) -> Mistake:
    return _frame(name, what, change_arguments("frame.two_colors", **changes))


FRAME = (
    _frame(
        "newest_motion_for_all",
        "one motion for the three colours",
        returns("frame.motion_by_step", lambda motions: dict.fromkeys(motions, motions[min(motions)]) if motions else motions),
    ),
    _steps("one_step_too_far", "each motion one frame too far", 1),
    _steps("one_step_short", "each motion one frame short", -1),
    _frame(
        "steps_ignored",
        "every frame an EF of 1, 3, 5",
        change_arguments(
            "frame.prepare", inputs=lambda inputs: replace(inputs, steps=(1, 3, 5)) if len(inputs.motions) > 4 else inputs
        ),
    ),
    _motions("motions_oldest_first", "takes the motions as oldest first", lambda motions, steps: motions[: max(steps)][::-1]),
    _motions(
        "last_motions", "takes the last motions, of more than the steps need", lambda motions, steps: motions[-max(steps) :]
    ),
    _frame(
        "lost_motion_is_still",
        "motion that is not finite counts as 0",
        change_arguments("frame.warp_one", motion=lambda motion: None if motion is None else _or_0(motion)),
    ),
    _frame(
        "lost_position_is_0",
        "a position that is not finite counts as 0",
        change_arguments("frame.holes", position_previous=_or_0),
    ),
    _frame("nearest_chain", "the nearest pixel's motion", put("motion_chain.GATHERS", {"longest": gather_nearest})),
    _frame(
        "hole_test_ignored", "always the footprint's hole test", change_arguments("frame.prepare", test=lambda _: "footprint")
    ),
    _order("stencil_of_now", "the current stencil in the place of the earlier one", "stencils", 0, 0, 0, 0),
    _order("normal_one_off", "normals of the next newer frame", "normals", 0, 0, 1, 2),
    _order("normal_of_newest", "the newest colour's normals throughout", "normals", 0, 1, 1, 1),
    _order("position_one_off", "positions of the next newer frame", "positions", 0, 0, 1, 2),
    _other("warp_one", "roughness_for_depth", "roughness for depth in the holes", "gbuffer", _roughness_for_depth),
    _other("fill", "splat_by_roughness", "roughness for depth in the splat", "gbuffer", _roughness_for_depth),
    *(
        _other(where, f"{name}_{word}", f"depth in {what} {words}", "gbuffer", _depth(change))
        for name, what, change in (("depth_of_16_bits", "16 bits", _of_16_bits), ("half_depth", "half precision", half))
        for where, word, words in (
            ("warp_one", "in_holes", "in the holes"),
            ("fill", "in_splat", "in the splat"),
            ("prepare", "everywhere", "everywhere"),
        )
    ),
    _other("fill", "filled_from_middle", "fills from the middle frame", "colors", lambda colors: colors[[1, 1, 2]]),
    _frame("missing_not_masked", "a missing frame keeps its mask", put("frame.is_missing", lambda steps, i: False)),
    _frame(
        "missing_by_newest",
        "missing only where the step is the newest's",
        put("frame.is_missing", lambda steps, i: i > 0 and steps[i] == steps[0]),
    ),
    _frame(
        "missing_not_warped",
        "a missing frame is not warped again",
        change_arguments("frame.warp_one", motion=lambda motion, inputs, i: None if _missing(inputs, i) else motion),
    ),
    _frame(
        "holes_not_masked",
        "only off screen is a hole",
        returns("frame.holes", lambda valid, motion: valid | leads_inside(follow(motion))),
    ),
    _picture("warped_first", "warped before occlusion_warp", first=lambda _, second: second, second=lambda _, first: first),
    _picture("warped_twice", "warped in the place of occlusion_warp", first=lambda _, second: second),
    _picture("filled_twice", "occlusion_warp in the place of warped", second=lambda _, first: first),
    _frame(
        "hole_fill_ignored", "always the occlusion warp", change_arguments("frame.prepare", hole_fill=lambda _: "occlusion_warp")
    ),
    _frame("filled_everywhere", "fills valid pixels, too", change_arguments("frame.fill", valid=np.zeros_like)),
    _frame("history_newest_first", "history newest first", returns("frame.stack_history", lambda history: history[::-1])),
    _frame(
        "history_mask_of_newest",
        "the newest mask with all three",
        change_arguments("frame.stack_history", valids=lambda valids: valids[:1] * 3),
    ),
    _prepared("mask_of_oldest", "the oldest mask as the network's", mask=lambda result: result.history[0, ..., 3]),
    _prepared("mask_of_all", "the network's mask: valid in all three", mask=lambda result: result.history[..., 3].prod(axis=0)),
    _prepared("mask_all_valid", "the network's mask all 1", mask=lambda result: np.ones_like(result.mask)),
    *DETAILS,
    _frame("negative_color", "colours below 0 stay", put("frame.two_colors", lambda *both: np.concatenate(both, axis=-1))),
    _frame("negative_history", "colours below 0 stay in the history", put("frame.stack_history", _signed_history)),
    _frame(
        "absolute_history",
        "colours below 0 change their sign in the history",
        put("frame.stack_history", lambda warped, valids: _signed_history(warped, valids, np.abs)),
    ),
    _frame("color_up_to_1", "colours above 1 become 1", returns("frame.two_colors", lambda color: np.minimum(color, 1))),
)
