# SPDX-License-Identifier: MIT
"""Stage warp."""

import numpy as np
from hypothesis import strategies as st

from conformance.cases.planes import Float64, colors, dyadic_motions, sizes
from conformance.cases.stage_inputs import Inputs, warp_inputs, wide_warp_inputs
from conformance.judging.judge import Judge
from conformance.judging.questions import Talk, ask
from conformance.suite.properties import (
    agrees_in_large_frames,
    agrees_in_windows,
    agrees_on_engines,
    cases,
    keeps_nothing_by_a_part,
    same_twice,
)


@cases(warp_inputs())
def test_agrees_with_the_reference(judge: Judge, inputs: Inputs) -> Talk:
    """The warped colour is the float64 reference's, also far outside the frame and where motion is not finite."""
    yield from judge.agrees("warp", inputs)


@cases(wide_warp_inputs())
def test_wide_frames_lose_nothing(judge: Judge, inputs: Inputs) -> Talk:
    """Thousands of pixels from the corner the fraction has all bits of the motion, since it does not come from a rounded sum."""
    yield from judge.agrees("warp", inputs)


@cases(warp_inputs(color="flat"))
def test_one_colour_stays_one_colour(judge: Judge, inputs: Inputs) -> Talk:
    """A flat frame comes back bit for bit: no weight is lost, nothing leaks in at the border."""
    got = yield ask("warp", inputs)
    judge.same("warp.warped", got["warped"], judge.round_inputs(inputs, "warp")["color"])


@cases(st.sampled_from(["still", "whole"]).flatmap(lambda motion: warp_inputs(motion=motion)))
def test_whole_pixels_move_exactly(judge: Judge, inputs: Inputs) -> Talk:
    """Motion of whole pixels copies pixels; outside the frame, it copies the nearest border pixel."""
    got = yield ask("warp", inputs)
    color, motion = judge.round_inputs(inputs, "warp")["color"], inputs["motion"].astype(int)
    height, width, _ = color.shape
    y, x = np.indices((height, width))
    x, y = x + motion[..., 0], y + motion[..., 1]
    judge.same("warp.warped", got["warped"], color[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)])
    judge.same("warp.inside", got["inside"], ((x >= 0) & (x < width) & (y >= 0) & (y < height)).astype(np.uint8))


@cases(warp_inputs().flatmap(lambda inputs: st.tuples(st.just(inputs), st.permutations(range(inputs["color"].shape[-1])))))
def test_channels_do_not_mix(judge: Judge, case: tuple[Inputs, list[int]]) -> Talk:
    """Permuting the channels permutes the result, bit for bit."""
    inputs, order = case
    whole, turned = yield ask("warp", inputs), ask("warp", {**inputs, "color": inputs["color"][..., order]})
    judge.same("warp.warped", turned["warped"], whole["warped"][..., order])


@cases(
    sizes(12).flatmap(lambda size: st.tuples(colors(size, 3), dyadic_motions(size, "short"), st.sampled_from([np.nan, np.inf])))
)
def test_lost_motion_is_off_screen(judge: Judge, case: tuple[Float64, Float64, float]) -> Talk:
    """A pixel with non-finite motion, in either component, is off screen and copies its own colour; it spoils no other pixel."""
    color, motion, value = case
    broken = motion.copy()
    broken[::2, ::3, 1] = value
    broken[1::2, ::3, 0] = -value
    got, clean = yield [ask("warp", {"color": color, "motion": m}) for m in (broken, motion)]
    finite = np.isfinite(broken).all(axis=-1)
    judge.same("warp.inside", got["inside"], np.where(finite, clean["inside"], 0))
    own = judge.round_inputs({"color": color})["color"]
    judge.same("warp.warped", got["warped"], np.where(finite[..., None], clean["warped"], own))


test_the_same_twice = same_twice("warp", cases(warp_inputs(), slow=True))


test_agrees_on_what_engines_send = agrees_on_engines("warp")


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("warp")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("warp")


test_a_users_size_agrees_in_windows = agrees_in_windows("warp")
