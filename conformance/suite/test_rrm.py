# SPDX-License-Identifier: MIT
"""Stage rrm."""

import numpy as np

from conformance.cases.stage_inputs import Inputs, rrm_inputs
from conformance.judging.judge import Judge
from conformance.judging.questions import Talk, ask
from conformance.suite.properties import agrees_in_large_frames, cases


@cases(rrm_inputs())
def test_agrees_with_the_reference(judge: Judge, inputs: Inputs) -> Talk:
    """The rectangle, and nothing else, is masked."""
    yield from judge.agrees("rrm", inputs)


@cases(rrm_inputs())
def test_twice_is_once(judge: Judge, inputs: Inputs) -> Talk:
    """Masking what is masked changes nothing."""
    once = (yield ask("rrm", inputs))["valid"]
    twice = yield ask("rrm", {**inputs, "valid": once})
    judge.same("rrm.valid", twice["valid"], once)


@cases(rrm_inputs())
def test_as_many_as_the_rectangle_has(judge: Judge, inputs: Inputs) -> Talk:
    """In a frame that is all valid, exactly height times width pixels are masked."""
    valid = (yield ask("rrm", {**inputs, "valid": np.ones_like(inputs["valid"])}))["valid"]
    _, _, height, width = inputs["rectangle"]
    judge.same("rrm.valid", np.array(valid.size - int(valid.sum())), np.array(int(height * width)))


test_large_frames_agree_with_the_reference = agrees_in_large_frames("rrm")
