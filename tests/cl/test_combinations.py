"""Every way to gather, to skip and to store, on both classes of device: each cell of the table is run once, on small frames."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from conformance.tolerance import ratio
from stss.frames.backends import ReferenceBackend
from stss.frames.display_frame import window_at
from stss.frames.supersample import plan
from stss_cl.network.network import PRECISIONS
from stss_cl.skip.stream import SKIPS, Stream
from stss_ref.motion_chain import GATHERS
from tests.cl.test_stream import WEIGHTS, assert_same, first_frame, next_frame

SIZE = 19, 45  # rows of eight pixels and the rest of one; whole tiles and cut ones
CHANGES = (*6 * ["nothing"], "moving", "moving", "pixel", "moving", "nothing", "moving", "rectangle", "moving")


@cache
def windows():
    """(window, steps) of each frame of a sequence in which some things move, and others stay."""
    rng = np.random.default_rng(4)
    frames = [first_frame(rng, SIZE, rendered=True)]
    color, made = frames[0].color, []
    for i, change in enumerate(CHANGES, start=1):
        frame, color = next_frame(rng, frames[-1], color, change, rendered=i % 2 == 0)
        frames.append(frame)
    for i in range(len(frames)):
        window = window_at(frames, i)
        made.append((window, plan(window).steps))
    return made


@cache
def right(gather):
    """Images and masks of the reference in float32."""
    reference = ReferenceBackend(WEIGHTS, gather)
    return [reference.compute(window, steps) for window, steps in windows()]


@cache
def whole(device, precision, gather):
    """Images and masks of a device that keeps nothing."""
    stream = Stream(WEIGHTS, device, precision, gather, skip="off")
    return [stream(window, steps) for window, steps in windows()]


@pytest.mark.parametrize("skip", SKIPS)
@pytest.mark.parametrize("gather", GATHERS)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_every_combination_gives_the_frames_of_off(device, precision, gather, skip):
    """Those of `off` are the reference's; `exact` has its bits."""
    off = whole(device, precision, gather)
    if skip == "off":
        for (image, valid), (want, want_valid) in zip(off, right(gather), strict=True):
            np.testing.assert_array_equal(valid, want_valid)
            assert ratio(f"network.cl.{precision}", image, want.astype(np.float64)) <= 1
        return
    stream, in_part = Stream(WEIGHTS, device, precision, gather, skip=skip), [0, 0]
    for i, ((window, steps), want) in enumerate(zip(windows(), off, strict=True)):
        assert_same(stream(window, steps), want)
        in_part[i % 2] += stream.report.network == "changed"
    assert min(in_part) > 0  # of either kind, or nothing was tried
