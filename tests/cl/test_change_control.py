# SPDX-License-Identifier: MIT
"""The frames in which the stream looks for changes, as literal sequences, so that a new one is never an accident; images do not depend on
it."""

from dataclasses import replace

import numpy as np
import pytest

from conformance.scenes import SCENES
from stss.sequence.scenes import display_frames
from stss_cl.skip.stream import Stream
from tests.cl.films import SHIPPED, UNREAD, WEIGHTS, assert_same, calls_of, film

STOPS = film(8 * ("everything",) + 60 * ("nothing",) + 20 * ("rectangle",) + 30 * ("everything",), seed=3)


def decisions_of(stream, frames, plain=None):
    """For each frame the first letter of the part of the network that was run: whole, changed, none."""
    letters = ""
    for call in calls_of(frames):
        image = stream(*call)
        letters += stream.cost.network[0]
        if plain is not None:
            assert_same(image, plain(*call))
    return letters


def test_where_something_changes(gpu):
    """What changed is computed. After eight frames that changed everywhere the stream does not look until the 48th; then all that moved
    is computed."""
    assert decisions_of(Stream(SHIPPED, gpu), STOPS) == 55 * "w" + 5 * "c" + 9 * "n" + 20 * "c" + 30 * "w"


@pytest.mark.parametrize(
    ("weights", "decisions"),
    [(WEIGHTS, 34 * "w" + 4 * "c" + 6 * "n"), (UNREAD, 28 * "w" + "cw" + 14 * "n")],
    ids=["read", "unread"],
)
def test_a_camera_that_stops(processor, weights, decisions, monkeypatch):
    """The bits are those of `off`, also in the frames without a look for changes, and in those after them."""
    frames = list(display_frames(SCENES["pan"], (40, 64), 28))
    last, colored = frames[-1], frames[-2].color
    for i in range(28, 44):
        frames.append(replace(last, number=i, color=colored if i % 2 == 0 else None, motion=np.zeros_like(last.motion)))
    monkeypatch.setattr("stss_cl.skip.change_control.REST", 4)
    assert decisions_of(Stream(weights, processor), frames, Stream(weights, processor, skip="off")) == decisions
