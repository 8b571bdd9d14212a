# SPDX-License-Identifier: MIT
"""Stage network: the whole network, at any size."""

import numpy as np
from hypothesis import strategies as st

from conformance.answers.expected import Expected
from conformance.cases.planes import sizes
from conformance.cases.stage_inputs import Inputs, network_inputs, weights
from conformance.judging.judge import Judge
from conformance.judging.questions import Talk, ask
from conformance.suite.properties import agrees_in_large_frames, agrees_in_windows, cases, keeps_nothing_by_a_part, same_twice
from stss_ref.weights import Weights, zeros

CASES = st.tuples(network_inputs("network", sizes(20)), weights())
STILL = zeros()


@cases(CASES, slow=True)
def test_agrees_with_the_reference(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """The image is the float64 reference's, also at sizes that are not multiples of 8."""
    yield from judge.agrees("network", *case)


@cases(CASES, slow=True)
def test_padding_repeats_the_last_row_and_column(judge: Judge, case: tuple[Inputs, Weights]) -> Talk:
    """If a frame is padded before the network and its image is cropped, the image is the same."""
    inputs, weights = case
    height, width = inputs["mask"].shape
    rows, columns = (np.minimum(np.arange(-(-n // 8) * 8), n - 1) for n in (height, width))
    padded = {n: a[rows[:, None], columns] if a.ndim == 2 else a[..., rows[:, None], columns, :] for n, a in inputs.items()}
    right = judge.right("network", inputs, weights)["image"]
    got, whole = yield ask("network", inputs, weights), ask("network", padded, weights)
    judge.holds("network.image", got["image"], Expected(whole["image"][: 2 * height, : 2 * width], 2 * np.asarray(right.allowed)))


@cases(network_inputs("network", sizes(20)), slow=True)
def test_without_a_residual_it_is_bilinear(judge: Judge, inputs: Inputs) -> Talk:
    """With weights of 0 the image is the first three colours upsampled, within their own range."""
    got = (yield ask("network", inputs, STILL))["image"]
    color = judge.exactly(inputs, "network")["color"][..., :3]
    right = judge.right("network", inputs, STILL)["image"]
    judge.holds("network.image", got, Expected(np.clip(got, color.min(axis=(0, 1)), color.max(axis=(0, 1))), right.allowed))


test_the_same_twice = same_twice("network", cases(CASES, slow=True))


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("network")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("network")


test_a_users_size_agrees_in_windows = agrees_in_windows("network")
