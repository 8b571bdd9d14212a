# SPDX-License-Identifier: MIT
"""A stream of display frames: with any kept results, the image has the bits of a frame computed from nothing."""

from __future__ import annotations

import itertools
import weakref
from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stss.frames.display_frame import schedule_of
from stss_cl.device.discovery import CLASSES
from stss_cl.device.program import programs_of
from stss_cl.network.layers import COLUMNS
from stss_cl.network.strips import OVERLAP
from stss_cl.options import SKIPS
from stss_cl.skip.last_image import LastImage
from stss_cl.skip.stream import Stream
from stss_ref.arrays import ArrayError
from tests.cl.conftest import ALL_LAYERS, anew, watch_launches
from tests.cl.films import CHANGES, DETAILED, SHIPPED, UNREAD, WEIGHTS, assert_same, calls_of, film, weights_for
from tests.tiers import thorough


@st.composite
def sequences(draw):
    """(window, steps) of calls one after the other."""
    size = draw(st.tuples(st.integers(1, 30), st.integers(1, 72)))
    changes = draw(st.lists(st.sampled_from(CHANGES), min_size=4, max_size=12))
    frames = film(changes, size, draw(st.integers(0, 2**32 - 1)))
    calls = [(i, 6) for i in range(len(frames))]
    odd = draw(st.lists(st.tuples(st.integers(0, len(frames) - 1), st.integers(1, 6), st.integers(0, len(frames))), max_size=3))
    for last, length, where in odd:  # out of turn, repeated, or with the beginning cut off
        calls.insert(where, (last, length))
    windows = [frames[max(0, last - length + 1) : last + 1] for last, length in calls]
    return [(window, schedule.steps) for window in windows if (schedule := schedule_of(window))]


PAIRS = {
    "float32": ("float32", WEIGHTS),
    "half": ("half", WEIGHTS),
    "unread": ("float32", UNREAD),
    "detailed": ("float32", DETAILED),
    "shipped": ("float32", SHIPPED),
}
QUICK = {("cpu", "float32"), ("cpu", "detailed"), ("gpu", "shipped")}


@pytest.fixture(scope="module")
def pair(request, device):
    """A stream that keeps nothing, and one that keeps all it can."""
    precision, weights = PAIRS[request.param]
    return tuple(Stream(weights, device, precision, skip=skip) for skip in ("off", "exact"))


@pytest.mark.parametrize(
    ("device", "pair"),
    [case if case in QUICK else thorough(*case) for case in itertools.product(CLASSES, PAIRS)],
    indirect=True,
)
@settings(max_examples=5)
@given(calls=sequences())
def test_what_is_kept_changes_no_bit(pair, calls):
    """Nor an image that the caller holds: the next one may overwrite the last only if no caller holds it."""
    plain, keeping = pair
    images = []
    for window, steps in calls:
        image, valid = keeping(window, steps)
        assert_same((image, valid), plain(window, steps))
        images.append(((image, valid), (image.copy(), valid.copy())))
    for now, then in images:
        assert_same(now, then)
        assert not any(array.flags.writeable for array in now)


def still(count, size=(16, 24), change="nothing"):
    return film((count - 1) * [change], size, seed=1)


def test_a_frame_in_which_nothing_changed_costs_a_comparison(device):
    keeping, frames = Stream(weights_for(device), device), still(12)
    for i, call in enumerate(calls_of(frames)):
        keeping(*call)
        # At first older frames are missing, which SF and EF each must see gone.
        assert i < 7 or (keeping.cost.network, keeping.cost.changed) == ("none", 0)


@pytest.fixture
def compiled(monkeypatch):
    """The compilations from now on: programs, and kernels for a size of group, which PoCL compiles at their first launch."""
    programs = set()

    def launched(queue, kernel, group):
        programs.add((kernel.get_info(cl.kernel_info.PROGRAM).int_ptr, kernel.function_name, group))

    watch_launches(monkeypatch, launched)
    return lambda device: programs | programs_of(device).keys()


def shots(size):
    """Shots with all that a stream does: still, changed in places, all anew until nobody looks, the other parity, every frame rendered."""
    yield film(["nothing"] * 7 + ["pixel", "moving", "rectangle"], size)
    yield film(["everything"] * 12 + ["nothing"] * 2, size)
    yield film(["moving"] * 6, size, rendered=(False, True))
    yield film(["moving"] * 4, size, rendered=(True,))


@pytest.mark.parametrize("skip", SKIPS)
def test_what_is_expected_is_compiled_before_the_first_frame(device, compiled, skip):
    size, device = (16, 24), anew(device)
    stream, parts = Stream(weights_for(device), device, skip=skip), set()
    stream.expect(size, None if skip == "exact" else 0.4)  # in any order
    expected = compiled(device)
    assert len(expected) > (50 if device.is_cpu else 20)
    caches = stream._caches.keys()  # noqa: SLF001  (an EF packs no weights anew: seen nowhere else)
    assert caches == ({False, True} if skip == "exact" else set())
    for frames in shots(size):
        for window, steps in calls_of(frames):
            stream(window, steps)
            parts.add((stream.cost.network, steps[0] > 0))
            assert compiled(device) == expected
    whole = {("whole", False), ("whole", True)}
    assert parts == whole if skip == "off" else parts > whole | {("changed", True), ("none", False)}


def test_frames_older_than_the_window_are_let_go(gpu):
    """A frame at 1920 x 1080 out takes 40 MB."""
    stream, frames, window, masks = Stream(SHIPPED, gpu), still(12, change="everything"), [], []
    while frames:
        window = [*window[-5:], frames.pop(0)]
        masks.append(weakref.ref(window[-1].gbuffer))
        stream(window, schedule_of(window).steps)
    assert [ref() is not None for ref in masks] == 6 * [False] + 6 * [True]


def test_older_frames_show_detail_in_a_hole_of_the_newest(device):
    """The surface is another in one colour frame alone; the one before shows another colour there."""
    weights = DETAILED if device.is_cpu else SHIPPED
    keeping, plain, frames = Stream(weights, device), Stream(weights, device, skip="off"), still(12)
    frames[10].stencil[5:9, 6:12] = 1
    frames[8].color[5:9, 6:12] *= 0.5
    for call in calls_of(frames)[6:]:
        got, want = (stream(*call) for stream in (keeping, plain))
        assert_same(got, want)
    assert keeping.cost.network == "changed"
    assert not got[1].all()


@ALL_LAYERS
def test_what_weights_do_not_read_is_not_computed(device):
    """An older colour that changes costs weights that do not read it no more than a comparison, and those that do a part of the network.

    Of frame 8 the colour is another: SFs see it come and go in frames 8 and 10, 10 and 12, and 12 and 14, as far back as they read.
    """
    frames = still(16)
    color = frames[8].color.copy()
    color[:2, :3] += 0.1
    frames[8] = replace(frames[8], color=color)
    for weights, last in ((UNREAD, 10), (DETAILED, 14), (WEIGHTS, 14)):
        keeping, plain = Stream(weights, device), Stream(weights, device, skip="off")
        for i, call in enumerate(calls_of(frames)):
            assert_same(keeping(*call), plain(*call))
            if i >= 8 and i % 2 == 0:
                assert keeping.cost.network == ("changed" if i <= last else "none")


@pytest.mark.parametrize(("precision", "tall"), [thorough("float32-direct", False), ("float32", True), thorough("half", False)])
def test_nothing_is_computed_far_from_a_change(device, monkeypatch, precision, tall):
    """No further than the overlap of strips; and everything that did change is."""
    size, target = (800, 16) if tall else (16, 800), LastImage.target

    def poisoned(self, *, whole):
        buffer = target(self, whole=whole)
        if not whole:
            cl.enqueue_copy(device.queue, buffer, np.full((2 * size[0], 2 * size[1], 3), np.nan, np.float32))
        return buffer

    monkeypatch.setattr(LastImage, "target", poisoned)
    stream, plain = Stream(weights_for(device), device, precision), Stream(weights_for(device), device, precision, skip="off")
    across = 1 if tall or device.is_cpu else COLUMNS  # an image of a GPU is written in tiles
    changes, frames, reach = {8: 0, 12: 333, 16: 799}, still(17, size), OVERLAP[precision != "float32-direct"]
    for i, along in changes.items():
        frames[i].gbuffer[(along, 3) if tall else (3, along)] += 0.5
    for i, call in enumerate(calls_of(frames)):
        image, _ = stream(*call)
        if i == 6:
            before = image.copy()
        if i in changes:
            assert stream.cost.network == "changed"
            rows = np.flatnonzero(np.isfinite(image).any((1, 2) if tall else (0, 2))) // 2
            assert np.abs(rows - changes[i]).min() == 0
            assert rows.min() >= (changes[i] - reach) // across * across
            assert rows.max() < (changes[i] + reach) // across * across + across
            np.testing.assert_array_equal(np.where(np.isnan(image), before, image), plain(*call)[0])


@ALL_LAYERS
def test_the_attention_sees_keys_that_changed_alone(device):
    """Where its values are the same everywhere nothing else brings the change to it."""
    weights = WEIGHTS | {n: w * 0 for n, w in WEIGHTS.items() if n.startswith("latentEncoder") and n.endswith("weight")}
    keeping, plain, frames = Stream(weights, device), Stream(weights, device, skip="off"), still(13, (40, 128))
    for i, column in ((8, 0), (10, 5), (12, 15)):
        frames[i].gbuffer[:, 8 * column : 8 * column + 8] *= 0.5
    for i, call in enumerate(calls_of(frames)):
        got = keeping(*call)
        if i in (8, 10, 12):
            assert_same(got, plain(*call))
            assert keeping.cost.network == "changed"


@ALL_LAYERS
def test_activity_says_where(device):
    """Nothing in a still frame, everything in one computed whole; elsewhere it covers every pixel that now differs."""
    keeping, frames = Stream(WEIGHTS, device), still(14, (61, 93))
    frames[12].color[40:43, 70:74] += 0.1
    images = []
    for i, call in enumerate(calls_of(frames)):
        images.append(keeping(*call)[0].copy())
        activity = keeping.activity()
        assert activity.shape == (16, 24)
        if i == 0:
            assert (activity == 1).all()
        elif i in (9, 10, 11):
            assert (activity == 0).all()
    assert keeping.cost.network == "changed"
    assert activity.max() == activity[8:13, 15:20].max()
    assert activity.min() < 0.7 * activity.max() < 0.7  # far away only the deep layers changed
    differs = (images[13] != images[11]).any(axis=-1)
    tiles = np.add.reduceat(np.add.reduceat(differs, range(0, 122, 8), axis=0), range(0, 186, 8), axis=1) > 0
    assert tiles.any()
    assert (activity[tiles] > 0).all()


def test_an_image_may_be_copied_to_the_callers_array(device):
    """The array then belongs to the caller: a change of it shows in no other frame."""
    stream, plain, frames = (
        Stream(weights_for(device), device),
        Stream(weights_for(device), device, skip="off"),
        still(9, change="rectangle"),
    )
    out = np.empty((32, 48, 3), np.float32)
    for call in calls_of(frames):
        image, valid = stream(*call, out)
        assert image is out
        assert_same((image, valid), plain(*call))
        out[...] = np.nan
    for wrong in (out[1:], out.astype(np.float64), np.empty((32, 96, 3), np.float32)[:, ::2]):
        with pytest.raises(ArrayError, match="out: expected"):
            stream(frames[:5], (0, 2, 4), wrong)


def test_mistakes_name_what_is_wrong(device):
    frames, engine = still(6), Stream(weights_for(device), device)
    with pytest.raises(ArrayError, match="window: expected the 5 frames that the steps lead to, got 2"):
        engine(frames[:2], (0, 2, 4))
    with pytest.raises(ArrayError, match="window: expected a colour 1, 3, 5 frames back"):
        engine([replace(frame, color=None) for frame in frames], (1, 3, 5))


def test_work_groups_do_not_follow_the_size(device, monkeypatch):
    """PoCL compiles a kernel anew for every group, so a new size of frames would cost seconds."""
    groups = set()
    watch_launches(monkeypatch, lambda queue, kernel, group: groups.add((kernel.function_name, group)))
    counts = []
    for size in ((24, 40), (37, 147)):
        frames, stream = still(8, size), Stream(weights_for(device), device)
        frames[6].gbuffer[3:7, 2:9] += 0.1
        for call in calls_of(frames):
            stream(*call)
        # Those of the packing divide a width of 8, 16, 24 .., so they are one of four.
        counts.append({(name, group) for name, group in groups if not name.startswith("pack")})
        groups.clear()
    assert counts[0] == counts[1]
    assert len(counts[0]) > 10
    assert not device.is_cpu or all(group is not None for _, group in counts[0])


LAUNCHES = {("gpu", "SF"): 44, ("gpu", "EF"): 47, ("cpu", "SF"): 62, ("cpu", "EF"): 65}
"""Of a frame that is compared with none; of the network 38 on a GPU, 56 on a processor."""


@ALL_LAYERS
@pytest.mark.parametrize(("weights", "more"), [(WEIGHTS, 0), (DETAILED, 4)])
def test_a_frame_takes_no_more_launches_than_allowed(device, launched, weights, more):
    """On a GPU each costs as much as hundreds of thousands of multiply-adds; detail costs three, of an SF four."""
    stream = Stream(weights, device, skip="off")
    for window, steps in calls_of(film(["moving"] * 7)):
        launched.clear()
        stream(window, steps)
        kind = "EF" if window[-1].color is None else "SF"
        assert len(launched) <= LAUNCHES[device.device_class, kind] + more, launched
