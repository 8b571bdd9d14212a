# SPDX-License-Identifier: MIT
"""Stage accumulate."""

import numpy as np

from conformance.answers.expected import Expected
from conformance.cases.stage_inputs import Inputs, accumulate_inputs
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

CASES = accumulate_inputs()


@cases(CASES)
def test_agrees_with_the_reference(judge: Judge, inputs: Inputs) -> Talk:
    """The mean is the float64 reference's, with earlier images within the box, at its border and far outside."""
    yield from judge.agrees("accumulate", inputs)


@cases(accumulate_inputs(before="same", motion="still"))
def test_what_rests_stays(judge: Judge, inputs: Inputs) -> Talk:
    """An image that is the earlier ones' and does not move comes back bit for bit."""
    got = yield ask("accumulate", inputs)
    judge.same("accumulate.shown", got["shown"], judge.round_inputs(inputs, "accumulate")["image"])


@cases(accumulate_inputs(motion="out"))
def test_what_was_off_screen_is_the_image(judge: Judge, inputs: Inputs) -> Talk:
    """Where all motion leads out of the frame, or is not finite, the image comes back bit for bit."""
    got = yield ask("accumulate", inputs)
    judge.same("accumulate.shown", got["shown"], judge.round_inputs(inputs, "accumulate")["image"])


@cases(CASES, slow=True)
def test_no_colour_leaves_the_box(judge: Judge, inputs: Inputs) -> Talk:
    """No result is darker or brighter than the image in the 3 x 3 pixels around, except by rounding."""
    got = (yield ask("accumulate", inputs))["shown"]
    image = judge.exactly(inputs, "accumulate")["image"]
    around = np.lib.stride_tricks.sliding_window_view(np.pad(image, ((1, 1), (1, 1), (0, 0)), "edge"), (3, 3), axis=(0, 1))
    allowed = judge.right("accumulate", inputs)["shown"].allowed
    judge.holds("accumulate.shown", got, Expected(np.clip(got, around.min(axis=(-2, -1)), around.max(axis=(-2, -1))), allowed))


@cases(CASES)
def test_an_image_off_screen_might_not_be_there(judge: Judge, inputs: Inputs) -> Talk:
    """An older image that no motion leads into changes no bit."""
    image, motion = inputs["image"], np.full_like(inputs["motions"][:1], np.nan)
    alone = {"image": image, "earlier": inputs["earlier"][:1], "motions": inputs["motions"][:1]}
    more = {"earlier": np.stack([inputs["earlier"][0], image[::-1]]), "motions": np.concatenate([alone["motions"], motion])}
    one, two = yield ask("accumulate", alone), ask("accumulate", {**alone, **more})
    judge.same("accumulate.shown", two["shown"], one["shown"])


test_the_same_twice = same_twice("accumulate", cases(CASES, slow=True))


test_constants_are_those_of_the_specification = agrees_on_constants("accumulate")


test_agrees_on_what_engines_send = agrees_on_engines("accumulate")


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("accumulate")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("accumulate")


test_a_users_size_agrees_in_windows = agrees_in_windows("accumulate")
