"""How many launches a whole display frame takes: on a GPU, each costs as much as hundreds of thousands of multiply-adds."""

from collections import Counter

from stss_cl.skip.stream import Stream
from tests.cl.films import EARLIER, UNREAD, WEIGHTS, calls_of, film

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


def test_launches_of_a_whole_frame(device, launched):
    stream, found = Stream(WEIGHTS, device), {}
    for window, steps in calls_of(film(["moving"] * 7)):
        stream._control.frames_unlooked = 100
        launched.clear()
        stream(window, steps)
        found["EF" if window[-1].color is None else "SF"] = Counter(launched)
    which = device.device_class
    counts = {kind: sum(names.values()) for kind, names in found.items()}
    assert counts == {kind: NETWORK[which] + AROUND[which, kind] for kind in ("SF", "EF")}, found


def test_an_earlier_second_colour_costs_a_launch(device, launched):
    """Its frame is prepared before the newest one; an SF has a chain of motion for it."""
    found = {}
    for weights in (UNREAD, EARLIER):
        stream = Stream(weights, device, skip="off")
        for window, steps in calls_of(film(["moving"] * 7)):
            launched.clear()
            stream(window, steps)
            found[weights is EARLIER, window[-1].color is None] = Counter(launched)
    for extrapolated in (False, True):
        more = found[True, extrapolated] - found[False, extrapolated]
        assert more.pop("prepare_older") == 1
        assert set(more) <= {"chain_steps"}
