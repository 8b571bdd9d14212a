# SPDX-License-Identifier: MIT
"""Stage occlusion_warp."""

import numpy as np
from hypothesis import strategies as st

from conformance.cases.stage_inputs import Inputs, occlusion_inputs
from conformance.judging.judge import Judge
from conformance.judging.questions import Talk, ask
from conformance.suite.properties import (
    agrees_in_large_frames,
    agrees_in_windows,
    agrees_on_constants,
    agrees_on_engines,
    cases,
    keeps_nothing_by_a_part,
    same_twice,
)

CASES = occlusion_inputs()


@cases(CASES)
def test_agrees_with_the_reference(judge: Judge, inputs: Inputs) -> Talk:
    """The looked-up motion is a copy, bit for bit; the colour read by it is right within rounding."""
    yield from judge.agrees("occlusion_warp", inputs)


@cases(st.sampled_from(["still", "whole", "half", "short"]).flatmap(lambda kind: occlusion_inputs(motion=kind)))
def test_as_one_pixel_after_the_other(judge: Judge, inputs: Inputs) -> Talk:
    """The splat gives the map of a loop over the pixels in raster order, also where depths are equal."""
    got = (yield ask("occlusion_warp", inputs))["occlusion_motion"]
    judge.same(
        "occlusion_warp.occlusion_motion",
        got,
        _loop(inputs["motion"], judge.round_inputs(inputs, "occlusion_warp")["depth"]).astype(np.float32),
    )


@cases(occlusion_inputs(motion="half"))
def test_only_the_order_of_depths_counts(judge: Judge, inputs: Inputs) -> Talk:
    """Half of all depths, which is exact, gives the same motion: only the order of depths counts."""
    near = {**inputs, "depth": np.minimum(judge.exactly(inputs, "occlusion_warp")["depth"], 1)}
    halved = {**near, "depth": near["depth"] / 2}
    first, second = yield [ask("occlusion_warp", i) for i in (near, halved)]
    judge.same("occlusion_warp.occlusion_motion", second["occlusion_motion"], first["occlusion_motion"])


@cases(CASES)
def test_one_colour_fills_with_itself(judge: Judge, inputs: Inputs) -> Talk:
    """In a frame of one colour every hole is filled with that colour, bit for bit."""
    flat = np.broadcast_to(judge.round_inputs(inputs, "occlusion_warp")["color"][:1, :1], inputs["color"].shape)
    got = (yield ask("occlusion_warp", {**inputs, "color": flat, "warped": flat}))["occlusion_warp"]
    judge.same("occlusion_warp.occlusion_warp", got, flat)


test_the_same_twice = same_twice("occlusion_warp", cases(CASES, slow=True))


test_constants_are_those_of_the_specification = agrees_on_constants("occlusion_warp")


test_agrees_on_what_engines_send = agrees_on_engines("occlusion_warp")


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("occlusion_warp")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("occlusion_warp")


test_a_users_size_agrees_in_windows = agrees_in_windows("occlusion_warp")


def _loop(motion: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """The splat as a plain loop (spec 5), for motion of halves and quarters."""
    height, width = depth.shape
    nearest, earlier = np.full((height, width), 10.0), np.zeros_like(motion)
    corner = np.floor(motion + np.moveaxis(np.indices((height, width))[::-1], 0, -1)).astype(int)
    for y, x in np.ndindex(height, width):
        for j, i in ((0, 0), (0, 1), (1, 0), (1, 1)):
            at = corner[y, x, 1] + j, corner[y, x, 0] + i
            if 0 <= at[0] < height and 0 <= at[1] < width and depth[y, x] < nearest[at]:
                nearest[at], earlier[at] = depth[y, x], motion[y, x]
    return earlier[np.clip(corner[..., 1], 0, height - 1), np.clip(corner[..., 0], 0, width - 1)]
