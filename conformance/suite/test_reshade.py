# SPDX-License-Identifier: MIT
"""Stage reshade."""

import numpy as np

from conformance.cases.stage_inputs import Inputs, reshade_inputs
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

CASES = reshade_inputs()


@cases(CASES)
def test_agrees_with_the_reference(judge: Judge, inputs: Inputs) -> Talk:
    """The colours are right within rounding; where rounding decides whether a sample is a hole's own, any mean is right."""
    yield from judge.agrees("reshade", inputs)


@cases(reshade_inputs(color="unit"), slow=True)
def test_what_is_no_hole_stays(judge: Judge, inputs: Inputs) -> Talk:
    """Outside holes the warped colour is a copy, bit for bit."""
    got = (yield ask("reshade", inputs))["reshade"]
    valid = inputs["valid"][..., None] != 0
    want = judge.round_inputs(inputs, "reshade")["warped"]
    judge.same("reshade.reshade", np.where(valid, got, 0), np.where(valid, want, np.float32(0)))


@cases(CASES, slow=True)
def test_what_was_read_in_holes_is_the_last_resort(judge: Judge, inputs: Inputs) -> Talk:
    """Warped colours in holes change only holes without any other source, which show these colours, bit for bit."""
    exact = judge.exactly(inputs, "reshade")
    hole = exact["valid"][..., None] == 0
    first, second = yield [ask("reshade", exact | {"warped": np.where(hole, x, exact["warped"])}) for x in (0.25, 0.75)]
    changed = (first["reshade"] != second["reshade"]).any(axis=-1, keepdims=True)
    judge.same(
        "reshade.reshade",
        np.where(changed, first["reshade"], 0),
        np.where(changed & hole, np.float32(0.25), np.float32(0)) + 0 * first["reshade"],
    )


test_the_same_twice = same_twice("reshade", cases(CASES, slow=True))


test_constants_are_those_of_the_specification = agrees_on_constants("reshade")


test_agrees_on_what_engines_send = agrees_on_engines("reshade")


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("reshade")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("reshade")


test_a_users_size_agrees_in_windows = agrees_in_windows("reshade")
