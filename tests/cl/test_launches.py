"""How many launches a whole display frame takes: on a GPU, each costs as much as hundreds of thousands of multiply-adds."""

from collections import Counter

import pyopencl as cl
import pytest

from stss.frames.display_frame import window_at
from stss.frames.supersample import plan
from stss_cl.network.layers import Layers
from stss_cl.skip.stream import Stream
from tests.cl.test_device_frames import film
from tests.cl.test_stream import EARLIER, UNREAD, WEIGHTS

NETWORK = {"gpu": 38, "cpu": 56}
AROUND = {
    # arrive, chain_steps, prepare for each of three colour frames, downsample_8
    ("gpu", "SF"): 6,
    # and splat_nearest, splat_first, fill_holes
    ("gpu", "EF"): 9,
    # finite for each of four planes, then as above
    ("cpu", "SF"): 9,
    # finite for three, no colour; then as above
    ("cpu", "EF"): 11,
}
"""Launches before the network, of a frame that is compared with none."""


@pytest.fixture
def launched(monkeypatch):
    """The names of the kernels, in order, that would have been launched: their results do not matter here."""
    names = []

    def noted(queue, kernel, *_):
        names.append(kernel.function_name)
        return cl.enqueue_marker(queue)

    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", noted)
    monkeypatch.setattr(cl.Kernel, "__call__", lambda kernel, queue, *_, **__: noted(queue, kernel))
    return names


@pytest.mark.parametrize("skip", ["off", "exact"])
def test_launches_of_a_whole_frame(device, launched, skip):
    frames, stream, found = film(["moving"] * 7), Stream(WEIGHTS, device, skip=skip), {}
    for i in range(len(frames)):
        stream._control.frames_unlooked = 100
        window = window_at(frames, i)
        launched.clear()
        stream(window, plan(window).steps)
        found["EF" if window[-1].color is None else "SF"] = Counter(launched)
    which = device.device_class
    counts = {kind: sum(names.values()) for kind, names in found.items()}
    assert counts == {kind: NETWORK[which] + AROUND[which, kind] for kind in ("SF", "EF")}, found


def test_an_earlier_second_colour_costs_a_launch(device, launched):
    """Its frame is prepared before the newest one; an SF has a chain of motion for it."""
    frames, found = film(["moving"] * 7), {}
    for weights in (UNREAD, EARLIER):
        stream = Stream(weights, device, skip="off")
        for i in range(len(frames)):
            window = window_at(frames, i)
            launched.clear()
            stream(window, plan(window).steps)
            found[weights is EARLIER, window[-1].color is None] = Counter(launched)
    for extrapolated in (False, True):
        more = found[True, extrapolated] - found[False, extrapolated]
        assert more.pop("prepare_older") == 1
        assert set(more) <= {"chain_steps"}


def test_launches_of_the_network(device):
    assert len(Layers(device, WEIGHTS, 24, 40, "float32").launches) == NETWORK[device.device_class]
