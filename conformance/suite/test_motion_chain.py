# SPDX-License-Identifier: MIT
"""Stage motion_chain."""

import numpy as np
from hypothesis import strategies as st

from conformance.cases.planes import sizes
from conformance.cases.stage_inputs import Inputs, chain_inputs
from conformance.judging.judge import Judge
from conformance.judging.questions import Talk, ask
from conformance.suite.properties import (
    agrees_in_large_frames,
    agrees_in_windows,
    agrees_on_engines,
    cases,
    cases_of,
    keeps_nothing_by_a_part,
)


@cases(chain_inputs())
def test_agrees_with_the_reference(judge: Judge, inputs: Inputs) -> Talk:
    """The chained motion is the float64 reference's; where rounding picks the pixel or the longest motion, either pick is right."""
    yield from judge.agrees("motion_chain", inputs)


@cases(st.tuples(sizes(20), st.integers(2, 5), st.integers(-3, 3), st.integers(-3, 3)))
def test_one_speed_adds_up(judge: Judge, case: tuple[tuple[int, int], int, int, int]) -> Talk:
    """If all pixels move alike, the motion over k frames is k times that of one, while the path stays in the frame."""
    (height, width), count, dx, dy = case
    motion = np.broadcast_to(np.array([dx, dy], np.float64), (count, height, width, 2))
    got = (yield ask("motion_chain", {"motions": motion}))["motion"]
    y, x = np.indices((height, width))
    inside = np.ones((height, width), bool)
    for step in range(1, count):
        at = x + step * dx, y + step * dy
        # All four pixels of the corner count: a 0 from outside stops the chain.
        inside &= (at[0] >= 0) & (at[0] + 1 < width) & (at[1] >= 0) & (at[1] + 1 < height)
    want = np.where(inside[..., None], count * motion[0], got).astype(np.float32)
    judge.same("motion_chain.motion", got, want)


def _almost_still(rng: np.random.Generator) -> Inputs:
    """Two frames; the newer one moves by so little that adding it to a place would change nothing."""
    little = -(2.0 ** rng.integers(-40, -26, (12, 40, 2)))
    return {"motions": np.stack([little, rng.integers(1, 9, little.shape) / 4])}


@cases_of([_almost_still])
def test_a_motion_is_never_lost_in_a_sum(judge: Judge, inputs: Inputs) -> Talk:
    """A tiny motion to the left and up leads to the pixels there, however far the place is from the frame's corner (decision 13)."""
    yield from judge.agrees("motion_chain", inputs)


test_agrees_on_what_engines_send = agrees_on_engines("motion_chain")


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("motion_chain")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("motion_chain")


test_a_users_size_agrees_in_windows = agrees_in_windows("motion_chain")
