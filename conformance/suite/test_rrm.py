# SPDX-License-Identifier: MIT
"""Stage rrm."""

from conformance.cases.stage_inputs import Inputs, rrm_inputs
from conformance.judging.judge import Judge
from conformance.judging.questions import Talk
from conformance.suite.properties import agrees_in_large_frames, cases, keeps_nothing_by_a_part


@cases(rrm_inputs())
def test_agrees_with_the_reference(judge: Judge, inputs: Inputs) -> Talk:
    """Only the rectangle is masked."""
    yield from judge.agrees("rrm", inputs)


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("rrm")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("rrm")
