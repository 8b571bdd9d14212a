# SPDX-License-Identifier: MIT
"""What is decided for each frame of a stream: literal sequences, so that another one is never an accident."""

from dataclasses import replace

import numpy as np
import pytest

from conformance.scenes import SCENES
from stss.sequence.scenes import display_frames
from stss_cl.skip.change_control import RULES, ChangeControl
from stss_cl.skip.stream import Stream
from tests.cl.films import UNREAD, WEIGHTS, assert_same, calls_of
from tests.cl.films import film as noise

MOVING = 28
RECTANGLES = 8 * ("nothing",) + 40 * ("rectangle",)
STOPS = 8 * ("everything",) + 60 * ("nothing",) + 20 * ("rectangle",) + 30 * ("everything",)


@pytest.fixture(scope="module")
def film():
    """A camera that moves, and then stands still."""
    frames = list(display_frames(SCENES["pan"], (40, 64), MOVING))
    for i in range(MOVING, MOVING + 16):
        last, colored = frames[MOVING - 1], frames[MOVING - 2].color
        frames.append(replace(last, number=i, color=colored if i % 2 == 0 else None, motion=np.zeros_like(last.motion)))
    return frames


def read(decisions):
    """``w 3c`` is ``wccc``."""
    return "".join(word[-1] * int(word[:-1]) if word[0].isdigit() else word for word in decisions.split())


def shown(stream, frames):
    """For each frame the part of the network that was run, and what came out."""
    for call in calls_of(frames):
        image = stream(*call)
        yield stream.report.network, image


@pytest.mark.parametrize(
    ("changes", "decisions"),
    [
        (RECTANGLES, "6w 3n 40c"),
        # Until the 48th after the eighth that changed everywhere nobody looks; then at first all that moved meanwhile is computed.
        (STOPS, "55w 5c 9n 20c 30w"),
    ],
)
def test_where_something_changes(gpu, changes, decisions):
    """What changed is computed; after frames that changed everywhere nobody looks for a while."""
    seen = "".join(network[0] for network, _ in shown(Stream(WEIGHTS, gpu), noise(changes, seed=3)))
    assert seen == read(decisions)


@pytest.mark.parametrize(("weights", "decisions"), [(WEIGHTS, "34w 4c 6n"), (UNREAD, "32w 2c 10n")], ids=["read", "unread"])
def test_a_camera_that_stops(processor, film, weights, decisions, monkeypatch):
    """The bits are those of `off`, also in the frames for whose changes nobody looked, and in those after them."""
    monkeypatch.setattr("stss_cl.skip.change_control.RULES", replace(RULES, rest=4))
    plain, keeping, seen = Stream(weights, processor, skip="off"), Stream(weights, processor), ""
    for (network, got), (_, want) in zip(shown(keeping, film), shown(plain, film), strict=True):
        assert_same(got, want)
        seen += network[0]
    assert seen == read(decisions)


def test_all_is_computed_where_most_has_changed():
    """A share of 1 is also that of a frame in which nobody looked."""
    control = ChangeControl()
    assert control.plan(0) == control.plan(RULES.most_changed) == "changed"
    assert control.plan(RULES.most_changed + 0.01) == control.plan(1) == "whole"


def test_changes_are_looked_for_again_after_a_rest():
    """After eight frames in a row, the 48th; if all has changed four more are enough, but eight after one with little change."""
    control, looks = ChangeControl(), ""
    for i in range(120):
        looks += "l" if control.begin() else "-"
        control.learn("changed" if i == 107 else "whole")
    assert looks == read("8l 47- 4l 47- ll 8l 4-")
