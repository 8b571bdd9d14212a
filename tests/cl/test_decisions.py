# SPDX-License-Identifier: MIT
"""What ``bounded`` decides for each frame of a stream: literal sequences, so that another one is never an accident."""

from dataclasses import replace
from functools import reduce
from operator import mul

import numpy as np
import pytest

from stss.frames.supersample import plan
from stss_cl.skip.error_control import RULES
from stss_cl.skip.stream import Stream
from tests.cl.test_stream import UNREAD, WEIGHTS, first_frame, next_frame

SIZE = (24, 40)
HALF_WEIGHTS = {name: tensor * np.float32(0.5) for name, tensor in WEIGHTS.items()}
STOPS = 100 * ("everything",) + 60 * ("nothing",) + 20 * ("rectangle",) + 30 * ("everything",) + 30 * ("nothing",)
RECTANGLES = 8 * ("nothing",) + 40 * ("rectangle",)


def film(seed, changes):
    """Display frames; where everything changes, the colours do by a hundredth: no other shot."""
    rng = np.random.default_rng(seed)
    made = first_frame(rng, SIZE, rendered=True)
    frames, color = [made], made.color
    for i, change in enumerate(changes, start=1):
        made, color = next_frame(rng, made, color, change, rendered=i % 2 == 0)
        if change == "everything":
            color = frames[0].color + np.float32(0.01) * color
        frames.append(replace(made, color=color if i % 2 == 0 else None))
    return frames


def read(decisions):
    """``w 3p`` is ``wppp``."""
    return "".join(word[-1] * int(word[:-1]) if word[0].isdigit() else word for word in decisions.split())


@pytest.mark.parametrize(
    ("weights", "seed", "changes", "max_error", "decisions", "grown"),
    [
        # Trials of a level farther and farther apart, then of a deeper one; no looking for changes for 48 frames after they ended.
        (
            HALF_WEIGHTS, 4, STOPS, 0.9,
            "wwWWppWW 6p WW 14p WW 30p WWppWW 6p WW 14p WW 16p wwcc 49n ccCC 6c CC 8c 30p WWppWW 6p WW 11p wwccc",
            4,
        ),
        # Weights that do not read the history; tolerances that are checked, and cut where they departed too far.
        (UNREAD, 3, RECTANGLES, 1e3, "ww 7n ccCC 6c CC 14c CC 12c", 6),
        (WEIGHTS, 3, RECTANGLES, 0.9, "wwWWppwwnccCC 6c CC 14c CPccC 7c Cc", None),
    ],
    ids=["camera", "wide", "narrow"],
)  # fmt: skip
def test_what_is_decided_for_each_frame(device, weights, seed, changes, max_error, decisions, grown):
    """A letter for each frame: none, changed, partly, whole; a capital where it was checked. ``grown``: steps of the tolerance, all up."""
    stream, frames, seen = Stream(weights, device, skip="bounded", max_error=max_error), film(seed, changes), ""
    for i in range(len(frames)):
        window = frames[max(0, i - 5) : i + 1]
        stream(window, plan(window).steps)
        network = stream.report.network[0]
        seen += network if stream.report.departure is None else network.upper()
    assert seen == read(decisions)
    if grown is not None:
        assert stream.tolerance == reduce(mul, grown * [RULES.faster], RULES.first_tolerance * max_error)
