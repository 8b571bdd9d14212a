"""Memory that a caller shares with us: arrays that are reused, images that are held, calls that end half-way."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pyopencl.array as cla
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from stss.frames.display_frame import WINDOW, schedule_of
from stss_cl.network.network import Network
from stss_cl.skip.stream import Stream
from stss_ref.arrays import ArrayError
from tests.cl.films import CHANGES, UNREAD, WEIGHTS, assert_same, calls_of, film, network_inputs

PLANES = ("color", "motion", "gbuffer", "nov", "stencil", "position")


class Film(NamedTuple):
    """Display frames: what changes from each to the next, which of them are rendered, and how many a window holds."""

    seed: int
    size: tuple[int, int]
    changes: tuple[str, ...]
    rendered: tuple[bool, ...]
    window: int


FILMS = st.builds(
    Film,
    seed=st.integers(0, 2**32 - 1),
    size=st.tuples(st.integers(1, 20), st.integers(1, 28)),
    changes=st.lists(st.sampled_from(CHANGES), min_size=6, max_size=12),
    rendered=st.sampled_from([(True, False), (True,), (True, False, True, True)]),
    window=st.integers(1, WINDOW),
)
FIRST_COLOR_LAST_READ = Film(1, (16, 24), ("nothing", "color", *7 * ["nothing"]), (True, False), WINDOW)
"""Frame 6 reads what frame 4 read but for the colour of frame 0, which has left the window."""


class Reuses:
    """A caller who has ``count`` sets of arrays, and writes each frame over the one that left the window."""

    def __init__(self, like, count):
        self._sets = [{name: np.empty_like(getattr(like, name)) for name in PLANES} for _ in range(count)]

    def __call__(self, frame):
        arrays = self._sets[frame.number % len(self._sets)]
        planes = {name: getattr(frame, name) for name in PLANES}
        for name, array in arrays.items():
            array[...] = np.nan if planes[name] is None else planes[name]
        return replace(frame, **{name: None if planes[name] is None else arrays[name] for name in PLANES})


def show(frames, length, *callers):
    """What each caller's stream, of (stream, caller), gives for each frame, and its report."""
    windows = [[] for _ in callers]
    for frame in frames:
        answers = []
        for (stream, caller), window in zip(callers, windows, strict=True):
            del window[: max(0, len(window) + 1 - length)]
            window.append(caller(frame))
            schedule = schedule_of(window)
            if schedule is not None:
                answers.append((stream(window, schedule.steps), stream.cost))
        if answers:
            yield answers


@pytest.fixture(scope="module", params=["read", "unread"])
def two_streams(request, device):
    """Of one kind, that have seen the same."""
    return [Stream({"read": WEIGHTS, "unread": UNREAD}[request.param], device) for _ in range(2)]


@settings(max_examples=4)
@example(case=FIRST_COLOR_LAST_READ)
@given(case=FILMS)
def test_arrays_may_be_rewritten_once_their_frame_left_the_window(two_streams, case):
    """As many sets of arrays as a window has frames give the bits, and the cost, of new arrays for every frame."""
    frames = film(case.changes, case.size, case.seed, case.rendered)
    callers = zip(two_streams, (Reuses(frames[0], case.window), lambda frame: frame), strict=True)
    for reused, fresh in show(frames, case.window, *callers):
        assert_same(reused[0], fresh[0])
        assert reused[1] == fresh[1]


def still_with(change, *, at, count=10):
    """Frames in which nothing changes but for ``change`` in frame ``at``, each all in arrays of its own."""
    return film([change if i == at else "nothing" for i in range(1, count)], (16, 24), 1)


def test_a_frame_that_left_the_window_and_comes_again_is_a_new_one(device):
    """A caller who goes back, writes other values into the arrays of what lay behind, and goes on with the same objects."""
    frames, other = still_with("nothing", at=0), still_with("everything", at=5)
    keeping, plain = Stream(WEIGHTS, device), Stream(WEIGHTS, device, skip="off")
    for last in (5, 6, 7, 4):
        window = frames[max(0, last + 1 - WINDOW) : last + 1]
        keeping(window, schedule_of(window).steps)
    for i in (5, 6, 7):
        for name in set(PLANES) - {"color"} | ({"color"} if i % 2 == 0 else set()):
            getattr(frames[i], name)[...] = getattr(other[i], name)
    for last in (5, 6, 7):
        window = frames[last + 1 - WINDOW : last + 1]
        assert_same(keeping(window, schedule_of(window).steps), plain(window, schedule_of(window).steps))


def test_a_stream_that_is_dropped_is_freed_at_once(device):
    """No cycle keeps its buffers until garbage is collected, and no cache keeps them for ever."""
    stream = Stream(WEIGHTS, device)
    for call in calls_of(still_with("nothing", at=0))[:6]:
        stream(*call)
    parts = stream._uploaded, *stream._caches.values()  # noqa: SLF001  (nothing else refers to them)
    references = [weakref.ref(each) for each in (stream, *parts)]
    del parts
    gc.disable()
    try:
        del stream
        assert [ref() for ref in references] == [None] * 4
    finally:
        gc.enable()


@pytest.mark.parametrize("broken", ["partial_network.PartialNetwork.run", "frame_cache.FrameCache.execute"])
def test_a_call_that_ends_half_way_leaves_nothing_behind(device, monkeypatch, broken):
    """Such as by Ctrl-C, or by a device that ran out of memory: the same frame again is right."""

    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    stream, plain = Stream(WEIGHTS, device), Stream(WEIGHTS, device, skip="off")
    for i, call in enumerate(calls_of(still_with("rectangle", at=8, count=14))):
        if i in (8, 9):
            with monkeypatch.context() as patch:
                patch.setattr(f"stss_cl.skip.{broken}", interrupted)
                with pytest.raises(KeyboardInterrupt):
                    stream(*call)
        assert_same(stream(*call), plain(*call))


def anywhere(array, first):
    """A copy that begins ``first`` floats behind where NumPy lets an array begin; -1: one that is not contiguous."""
    if first < 0:
        return np.asfortranarray(array)
    place = np.empty(array.size + first, np.float32)[first:].reshape(array.shape)
    place[...] = array
    return place


@pytest.mark.parametrize("first", [1, 2, 3, -1])
def test_arrays_may_lie_anyhow(device, first):
    """Kernels read four floats at once, from where four floats may lie: elsewhere the process ended."""
    network, inputs = Network(WEIGHTS, device), network_inputs((16, 24), 2)
    np.testing.assert_array_equal(network(*(anywhere(array, first) for array in inputs)), network(*inputs))


def test_a_part_of_an_array_on_the_device_is_that_part(device):
    """Not what lies at the beginning of its buffer."""
    network, inputs = Network(WEIGHTS, device), network_inputs((16, 24), 2)
    parts = [cla.to_device(device.queue, np.stack([np.full_like(array, 9), array]))[1] for array in inputs]
    np.testing.assert_array_equal(network(*parts).get(), network(*inputs))
    turned = cla.to_device(device.queue, inputs[2].T.copy()).T
    with pytest.raises(ArrayError, match="mask: expected a C-contiguous array"):
        network(*parts[:2], turned, parts[3])
