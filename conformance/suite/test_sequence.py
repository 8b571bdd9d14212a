# SPDX-License-Identifier: MIT
"""Whole sequences: a port may keep anything between frames, as long as that changes no result."""

from typing import Any

import numpy as np
from hypothesis import strategies as st

from conformance.cases.stage_inputs import Inputs, frame_inputs, frame_weights
from conformance.judging.judge import Judge
from conformance.judging.questions import Talk, ask
from conformance.suite.properties import cases
from stss_ref.weights import Weights

KINDS = ((0, 2, 4), (1, 3, 5))


@st.composite
def sequences(draw: st.DrawFn) -> list[tuple[str, Inputs, Weights]]:
    """Draw a sequence of calls: each has the next frame, the same one, a cut, a changed part, another size, or other weights."""
    weights = draw(frame_weights())
    size = draw(st.tuples(st.integers(1, 12), st.integers(1, 12)))
    frame = draw(frame_inputs(st.just(size), KINDS[0]))
    calls = [("first", frame, weights)]
    for i in range(draw(st.integers(1, 5))):
        what = draw(st.sampled_from(["next", "again", "cut", "part", "resize", "weights", "back"]))
        if what == "next":
            frame = _next(draw, frame, KINDS[i % 2])
        elif what == "cut":
            frame = draw(frame_inputs(st.just(size), KINDS[0]))
        elif what == "part":
            frame = {**frame, "colors": frame["colors"].copy()}
            frame["colors"][:, : size[0] // 2 + 1, : size[1] // 2 + 1] = draw(st.sampled_from([0.0, 0.25, 1.0]))
        elif what == "resize":
            size = draw(st.tuples(st.integers(1, 12), st.integers(1, 12)))
            frame = draw(frame_inputs(st.just(size), draw(st.sampled_from(KINDS))))
        elif what == "weights":
            weights = draw(frame_weights())
        elif what == "back":
            _, frame, weights = calls[0]
            size = frame["nov"].shape
        calls.append((what, frame, weights))
    return calls


@cases(sequences(), slow=True)
def test_every_frame_is_as_if_it_were_the_only_one(judge: Judge, calls: list[tuple[str, Inputs, Weights]]) -> Talk:
    """The frames in reverse order have the same bits, and the last one agrees with the reference, which keeps no state."""
    forth = yield [ask("frame", frame, weights) for _, frame, weights in calls]
    back = yield [ask("frame", frame, weights) for _, frame, weights in reversed(calls)]
    for first, second in zip(forth, reversed(back), strict=True):
        judge.same("frame.image", second["image"], first["image"])
    _, last, weights = calls[-1]
    judge.compare("frame", last, weights, forth[-1])


def _next(draw: st.DrawFn, frame: Inputs, steps: tuple[int, int, int]) -> dict[str, Any]:
    """The frame after this one: the newest becomes older."""
    newer = draw(frame_inputs(st.just(frame["nov"].shape), steps))
    moved = {name: np.concatenate([newer[name][:1], frame[name][:-1]]) for name in ("colors", "stencils", "normals", "positions")}
    return {**newer, **moved}
