# SPDX-License-Identifier: MIT
"""What is decided for each frame of a stream: literal sequences, so that another one is never an accident."""

import numpy as np
import pytest

from stss.frames.supersample import plan
from stss_cl.skip.stream import Stream
from tests.cl.test_error_control import MILD, MILD_UNREAD, MOVING, film
from tests.cl.test_stream import WEIGHTS, first_frame, next_frame

__all__ = ["film"]
RECTANGLES = 8 * ("nothing",) + 40 * ("rectangle",)
STOPS = 8 * ("everything",) + 60 * ("nothing",) + 20 * ("rectangle",) + 30 * ("everything",)


def noise(seed, changes):
    """Display frames without a flat tile."""
    rng = np.random.default_rng(seed)
    frames = [first_frame(rng, (24, 40), rendered=True)]
    color = frames[0].color
    for i, change in enumerate(changes, start=1):
        made, color = next_frame(rng, frames[-1], color, change, rendered=i % 2 == 0)
        frames.append(made)
    return frames


def read(decisions):
    """``w 3p`` is ``wppp``."""
    return "".join(word[-1] * int(word[:-1]) if word[0].isdigit() else word for word in decisions.split())


def decided(stream, frames):
    """A letter for each frame: none, changed, partly, whole; a capital where it was checked."""
    seen = ""
    for i in range(len(frames)):
        window = frames[max(0, i - 5) : i + 1]
        stream(window, plan(window).steps)
        network = stream.report.network[0]
        seen += network if stream.report.departure is None else network.upper()
    return seen


@pytest.mark.parametrize("weights", [MILD, MILD_UNREAD], ids=["read", "unread"])
@pytest.mark.parametrize(("max_error", "decisions"), [(0.9, "wwWWppWW 6p WW 12p"), (1e-6, "wwWW 24w")])
def test_a_camera_that_moves(device, film, weights, max_error, decisions):
    """Flat tiles are left out where that is within the bound, checked ever more rarely; for 48 frames nobody looks for changes."""
    assert decided(Stream(weights, device, skip="bounded", max_error=max_error), film[:MOVING]) == read(decisions)


@pytest.mark.parametrize(
    ("skip", "changes", "decisions"),
    [
        ("bounded", RECTANGLES, "wwWWppwwn 40c"),
        ("exact", RECTANGLES, "6w 3n 40c"),
        # 48 frames after the eighth that changed everywhere nobody looks; then at first for what was left out, or moved, meanwhile.
        ("exact", STOPS, "55w 5c 9n 20c 30w"),
    ],
)
def test_where_something_changes(device, skip, changes, decisions):
    """What changed is computed; after frames that changed everywhere nobody looks for a while."""
    assert decided(Stream(WEIGHTS, device, skip=skip, max_error=0.9), noise(3, changes)) == read(decisions)
