# SPDX-License-Identifier: MIT
"""Stage frame: a display frame from its buffers."""

import numpy as np
from hypothesis import strategies as st

from conformance.cases.every_buffer import frame_cases
from conformance.cases.near_limits import near_frames
from conformance.cases.stage_inputs import Inputs, frame_inputs, frame_weights, scene_inputs
from conformance.judging.judge import Judge
from conformance.judging.questions import Talk, ask
from conformance.suite.properties import (
    agrees_in_large_frames,
    agrees_in_windows,
    agrees_on_constants,
    agrees_on_engines,
    cases,
    cases_of,
    keeps_nothing_by_a_part,
    same_twice,
)
from stss_ref.weights import Weights

CASES = st.tuples(frame_inputs(), frame_weights())
STANDS = frame_inputs().map(lambda inputs: {**inputs, "motions": inputs["motions"] * 0})


@cases(CASES, slow=True)
def test_agrees_with_the_reference(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """The images of SF and EF, also with missing frames, are the float64 reference's; cases of undecided holes are counted."""
    yield from judge.agrees("frame", *case)


STARTS = st.sampled_from([(0, 0, 0), (1, 1, 1), (0, 2, 2), (1, 3, 3)])


@cases(st.tuples(STARTS.flatmap(lambda steps: frame_inputs(steps=steps)), frame_weights()), slow=True)
def test_agrees_at_the_start_of_a_sequence(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """Images agree, too, if older frames are missing: the oldest existing frame replaces them, fully masked."""
    yield from judge.agrees("frame", *case)


@cases(st.tuples(scene_inputs(), frame_weights()), slow=True)
def test_agrees_on_rendered_scenes(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """Images agree, too, on scenes whose motion, geometry and holes come from a renderer."""
    yield from judge.agrees("frame", *case)


@cases(st.tuples(STANDS, frame_weights()), slow=True)
def test_without_a_residual_a_still_frame_is_upsampled(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """If nothing moves and nothing is a hole, with weights of 0 an extrapolated frame has the same bits as a rendered one."""
    inputs, weights = case
    still = weights.convert(lambda tensor: tensor * 0)
    same = {**inputs, "positions": np.zeros_like(inputs["positions"])}
    same["stencils"] = np.zeros_like(inputs["stencils"])
    same["normals"] = np.broadcast_to([0.0, 0.0, 1.0], inputs["normals"].shape)
    frames = [{**same, "steps": np.array(steps, np.int32)} for steps in ((0, 0, 0), (1, 1, 1))]
    frames[1]["motions"] = np.zeros((1, *inputs["motions"].shape[1:]))
    rendered, extrapolated = yield [ask("frame", f, still) for f in frames]
    judge.same("frame.image", extrapolated["image"], rendered["image"])


@cases(st.tuples(frame_inputs(steps=(0, 2, 4)), frame_weights()), slow=True)
def test_a_rendered_frame_looks_for_no_other(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """With weights of 0 a rendered frame depends only on its own colour."""
    inputs, weights = case
    still = weights.convert(lambda tensor: tensor * 0)
    other = {**inputs, "colors": inputs["colors"].copy(), "motions": -inputs["motions"], "positions": inputs["positions"] * 2}
    other["colors"][1:] = 0.5
    first, second = yield [ask("frame", i, still) for i in (inputs, other)]
    judge.same("frame.image", second["image"], first["image"])


test_the_same_twice = same_twice("frame", cases(CASES, slow=True))


@cases_of(frame_cases())
def test_every_buffer_of_every_frame_counts(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """Images agree, too, on frames in which each stencil, normal, position and motion decides other pixels, at any steps."""
    yield from judge.agrees("frame", *case)


@cases_of(near_frames())
def test_comparisons_need_all_bits(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """The last bits of a surface's depth, view or normal in float32 decide a hole, or which surface fills it."""
    yield from judge.agrees("frame", *case)


test_constants_are_those_of_the_specification = agrees_on_constants("frame")


test_agrees_on_what_engines_send = agrees_on_engines("frame")


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("frame")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("frame")


test_a_users_size_agrees_in_windows = agrees_in_windows("frame")
