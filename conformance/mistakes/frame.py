# SPDX-License-Identifier: MIT
"""Mistakes in stage frame."""

# What is planted takes the reference's arrays.
# pyright: reportUnknownLambdaType=false

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from conformance.protocol.reference_copy import Mistake, change_arguments, fault, put, returns
from stss_ref.frame import stack_history
from stss_ref.motion_chain import motion_chain
from stss_ref.sample import follow, leads_inside

Change = Callable[..., Any]


_frame = partial(fault, "frame")


def _steps(name: str, what: str, by: int) -> Mistake:
    """Motions are chained over other steps."""

    def wrong(motions: Any, steps: Any, _: Any) -> Any:
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


def _missing(inputs: Any, i: int) -> bool:
    return i > 0 and inputs.steps[i] == inputs.steps[i - 1]


def _prepared(name: str, what: str, **changes: Change) -> Mistake:
    """The network is given others; each change has what was prepared as its argument."""
    return _frame(
        name, what, returns("frame.prepare", lambda made: replace(made, **{key: change(made) for key, change in changes.items()}))
    )


def _or_0(vectors: Any) -> Any:
    return np.where(np.isfinite(vectors).all(axis=-1, keepdims=True), vectors, 0)


def _signed_history(warped: Any, valids: Any, change: Callable[[Any], Any] = np.positive) -> Any:
    """The history with ``change`` of the colours in place of what is at least 0."""
    masks = stack_history(warped, valids)[..., 3:]
    return np.concatenate([np.stack([change(w) for w in warped[::-1]]), masks], axis=-1)


def _second(name: str, what: str, change: Change) -> Mistake:
    """The second colour of weights that want the earlier frame is ``change`` of other frames.

    These are the oldest, the middle and the newest one, as warped, with their masks; the right second colour, and the inputs.
    """

    def wrong(made: Any, inputs: Any, second: str) -> Any:
        if second == "newest":
            return made
        first, other = made.color[..., :3], made.color[..., 3:]
        return replace(made, color=np.concatenate([first, np.maximum(change(*made.history, other, inputs), 0)], axis=-1))

    return _frame(f"second_{name}", what, returns("frame.prepare", wrong))


def _trusted(by: Any, picture: Any, otherwise: Any) -> Any:
    """Where the mask of ``by`` is 1 the colours of ``picture``."""
    return np.where(by[..., 3:] > 0, picture[..., :3], otherwise[..., :3])


SECONDS = (
    _second("ignored", "the newest frame is the second colour, whatever the weights say", lambda o, m, n, *_: n[..., :3]),
    _frame(
        "second_black",
        "a black image for weights that want the earlier frame",
        returns("frame.frame", lambda got, weights: (got[0] * (weights.second_color == "newest"), got[1])),
    ),
    _second("unmasked", "the earlier frame is the second colour in its holes, too", lambda o, m, n, *_: m[..., :3]),
    _second("of_oldest", "the oldest frame for the earlier one as the second colour", lambda o, m, n, *_: _trusted(o, o, n)),
    _second("by_newest_mask", "the newest frame's holes for the earlier one's", lambda o, m, n, *_: _trusted(n, m, n)),
    _second(
        "black_in_holes", "the second colour is black in the earlier frame's holes", lambda o, m, n, *_: _trusted(m, m, n * 0)
    ),
    _second(
        "not_warped",
        "the earlier frame is the second colour, but not warped",
        lambda o, m, n, _, inputs: _trusted(m, inputs.colors[1], n),
    ),
    _second(
        "missing_trusted",
        "a missing earlier frame is the second colour",
        lambda o, m, n, other, inputs: m[..., :3] if _missing(inputs, 1) else other,
    ),
    _second(
        "ef_only", "an SF's second colour is the newest frame", lambda o, m, n, other, i: other if i.steps[0] else n[..., :3]
    ),
    _second(
        "sf_only", "an EF's second colour is the newest frame", lambda o, m, n, other, i: n[..., :3] if i.steps[0] else other
    ),
)


def _picture(name: str, what: str, **changes: Change) -> Mistake:
    return _frame(name, what, change_arguments("frame.two_pictures", **changes))


FRAME = (
    _frame(
        "newest_motion_for_all",
        "one motion for the three colours",
        returns("frame.motion_by_step", lambda motions, steps: dict.fromkeys(motions, motions.get(steps[0]))),
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
    _motions("motions_oldest_first", "motions taken as oldest first", lambda motions, steps: motions[: max(steps)][::-1]),
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
    _frame(
        "nearest_chain", "the chain by the nearest pixel", change_arguments("frame.motion_by_step", gather=lambda _: "nearest")
    ),
    _frame(
        "hole_test_ignored", "always the footprint's hole test", change_arguments("frame.prepare", test=lambda _: "footprint")
    ),
    _order("stencil_of_now", "the current stencils for the earlier ones", "stencils", 0, 0, 0, 0),
    _order("normal_one_off", "normals of the next newer frame", "normals", 0, 0, 1, 2),
    _order("normal_of_newest", "the newest colour's normals throughout", "normals", 0, 1, 1, 1),
    _order("position_one_off", "positions of the next newer frame", "positions", 0, 0, 1, 2),
    _other("warp_one", "roughness_for_depth", "roughness for depth in the holes", "gbuffer", _roughness_for_depth),
    _other("fill", "splat_by_roughness", "roughness for depth in the splat", "gbuffer", _roughness_for_depth),
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
    _frame("filled_everywhere", "fills what needs no filling", change_arguments("frame.fill", valid=np.zeros_like)),
    _frame("history_newest_first", "history newest first", returns("frame.stack_history", lambda history: history[::-1])),
    _frame(
        "history_mask_of_newest",
        "the newest mask with all three",
        change_arguments("frame.stack_history", valids=lambda valids: valids[:1] * 3),
    ),
    _prepared("mask_of_oldest", "the oldest mask as the network's", mask=lambda made: made.history[0, ..., 3]),
    _prepared("mask_of_all", "the network's mask: valid in all three", mask=lambda made: made.history[..., 3].prod(axis=0)),
    _prepared("mask_all_valid", "the network's mask all 1", mask=lambda made: np.ones_like(made.mask)),
    *SECONDS,
    _frame("negative_color", "colours below 0 stay", put("frame.two_pictures", lambda *both: np.concatenate(both, axis=-1))),
    _frame("negative_history", "colours below 0 stay in the history", put("frame.stack_history", _signed_history)),
    _frame(
        "absolute_history",
        "colours below 0 change their sign in the history",
        put("frame.stack_history", lambda warped, valids: _signed_history(warped, valids, np.abs)),
    ),
    _frame("color_up_to_1", "colours above 1 become 1", returns("frame.two_pictures", lambda color: np.minimum(color, 1))),
)
