# SPDX-License-Identifier: MIT
"""A stream of display frames: whatever is kept, the image has the bits of a frame computed from nothing."""

from __future__ import annotations

import threading
import weakref
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stss.frames.display_frame import DisplayFrame
from stss.frames.supersample import plan
from stss_cl.device import program
from stss_cl.skip.change_control import RULES
from stss_cl.skip.stream import SKIPS, Stream
from stss_cl.skip.uploaded_frames import UploadedFrames
from stss_ref.arrays import ArrayError
from stss_ref.weights import Weights
from stss_ref.weights import random as random_weights
from tests.cl.conftest import QUICK

CHANGES = ("nothing", "nothing", "pixel", "color", "rectangle", "moving", "everything")
WEIGHTS = random_weights(3)
UNREAD = WEIGHTS | {
    f"lowlevelGated.{name}.weight": np.zeros_like(WEIGHTS[f"lowlevelGated.{name}.weight"])
    for name in ("conv_feature", "conv_mask.0")
}
"""The same, but that do not read the history."""
EARLIER = Weights(UNREAD, "earlier")
"""The same again, whose second colour is that of the frame before."""


@dataclass(frozen=True)
class Sequence:
    """Display frames, and the windows asked for one after the other, each by its last frame and its length."""

    frames: tuple[DisplayFrame, ...]
    calls: tuple[tuple[int, int], ...]


def first_frame(rng, size, *, rendered):
    return DisplayFrame(
        number=0,
        color=rng.random((*size, 3), np.float32) if rendered else None,
        motion=np.zeros((*size, 2), np.float32),
        gbuffer=rng.random((*size, 9), np.float32),
        nov=rng.random(size, np.float32),
        stencil=np.zeros(size, np.float32),
        position=(rng.random((*size, 3), np.float32) * 20).astype(np.float32),
    )


def next_frame(rng, before, color, change, *, rendered):
    """The frame after ``before``, all of it in new arrays; ``color``: of the last frame that had one."""
    height, width = before.nov.shape
    planes = {name: getattr(before, name).copy() for name in ("gbuffer", "nov", "stencil", "position")}
    color, motion = color.copy(), np.zeros((height, width, 2), np.float32)
    y, x = int(rng.integers(height)), int(rng.integers(width))
    where = (
        np.s_[y : y + 1, x : x + 1]
        if change == "pixel"
        else np.s_[y : y + int(rng.integers(1, 9)), x : x + int(rng.integers(1, 9))]
    )
    where = np.s_[:, :] if change == "everything" else where
    if change != "nothing":
        color[where] = rng.random(color[where].shape, np.float32)
    if change in {"pixel", "rectangle", "everything"}:
        name = str(rng.choice(list(planes)))
        planes[name][where] = (
            rng.integers(0, 3, planes[name][where].shape) if name == "stencil" else rng.random(planes[name][where].shape)
        )
    if change in {"moving", "everything"}:
        motion[where] = rng.normal(0, 2, motion[where].shape)
        planes["stencil"][where] = 1
    return DisplayFrame(before.number + 1, color if rendered else None, motion, **planes), color


@st.composite
def sequences(draw):
    size = draw(st.tuples(st.integers(1, 30), st.integers(1, 44)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    made = first_frame(rng, size, rendered=True)
    frames, color = [made], made.color
    for i, change in enumerate(draw(st.lists(st.sampled_from(CHANGES), min_size=4, max_size=12)), start=1):
        made, color = next_frame(rng, made, color, change, rendered=i % 2 == 0)
        frames.append(made)
    calls = [(i, 6) for i in range(len(frames))]
    odd = draw(st.lists(st.tuples(st.integers(0, len(frames) - 1), st.integers(1, 6), st.integers(0, len(frames))), max_size=3))
    for last, length, where in odd:  # out of turn, repeated, or with the beginning cut off
        calls.insert(where, (last, length))
    return Sequence(tuple(frames), tuple(calls))


def windows(sequence):
    """(window, steps) of every call that can be answered."""
    for last, length in sequence.calls:
        window = sequence.frames[max(0, last - length + 1) : last + 1]
        planned = plan(window)
        if planned is not None:
            yield window, planned.steps


def assert_same(got, want):
    np.testing.assert_array_equal(got[0].view(np.uint32), want[0].view(np.uint32))
    np.testing.assert_array_equal(got[1], want[1])


@pytest.fixture(
    scope="module",
    params=[*((precision, WEIGHTS) for precision in QUICK), ("float32", UNREAD), ("float32", EARLIER)],
    ids=lambda p: p[0] + " unread" * (p[1] is UNREAD) + " earlier" * (p[1] is EARLIER),
)
def pair(request, device):
    """What keeps nothing, and what keeps all it can."""
    precision, weights = request.param
    return tuple(Stream(weights, device, precision, skip=skip) for skip in ("off", "exact"))


@settings(max_examples=25)
@given(sequence=sequences())
def test_what_is_kept_changes_no_bit(pair, sequence):
    plain, keeping = pair
    for window, steps in windows(sequence):
        assert_same(keeping(window, steps), plain(window, steps))


@settings(max_examples=10)
@given(sequence=sequences())
def test_an_image_in_somebodys_hands_stays_as_it_is(pair, sequence):
    """The next image may be written over the last one only where nobody has that any more."""
    _, keeping = pair
    held = []
    for window, steps in windows(sequence):
        image, valid = keeping(window, steps)
        held.append((image, image.copy(), valid, valid.copy()))
    for image, copy, valid, valid_copy in held:
        np.testing.assert_array_equal(image, copy)
        np.testing.assert_array_equal(valid, valid_copy)
        assert not image.flags.writeable


def still(count, size=(16, 24), change="nothing"):
    rng = np.random.default_rng(1)
    made = first_frame(rng, size, rendered=True)
    frames, color = [made], made.color
    for i in range(1, count):
        made, color = next_frame(rng, made, color, change, rendered=i % 2 == 0)
        frames.append(made)
    return frames


def test_a_frame_in_which_nothing_changed_costs_a_comparison(device):
    keeping, frames = Stream(WEIGHTS, device), still(12)
    for i in range(12):
        window = frames[max(0, i - 5) : i + 1]
        keeping(window, plan(window).steps)
        # At first older frames are missing, which SF and EF each must see gone.
        assert i < 7 or (keeping.report.network, keeping.report.prepared) == ("none", 0)


@pytest.fixture
def builds(monkeypatch):
    """The programs that frames wait for; none is built before the test. What is built behind them is not among them."""
    asked, made = [], program._build

    def build(device, file, options):
        if threading.current_thread() is threading.main_thread():
            asked.append((file, options))
        return made(device, file, options)

    # Not Program.build: a build that fails beside another process is tried twice.
    monkeypatch.setattr(program, "_build", build)
    monkeypatch.setattr(program, "_programs", WeakKeyDictionary())
    return asked


@pytest.mark.parametrize("skip", SKIPS)
def test_the_first_frame_waits_only_for_what_was_not_expected(device, monkeypatch, builds, skip):
    """And what it has no use for is not built before it: the kernels that compute changes alone."""
    first = still(1)
    plain, told, untold = (Stream(WEIGHTS, device, skip=s) for s in ("off", skip, skip))
    told.expect(first[0].nov.shape)
    expected = list(builds)
    got = told(first, (0, 0, 0))
    assert len(expected) > 25
    assert builds == expected
    if told._latest is not None:
        told._latest.network.settle()  # or its programs would be found
        assert builds == expected
    monkeypatch.setattr(program, "_programs", WeakKeyDictionary())
    assert_same(untold(first, (0, 0, 0)), got)
    assert sorted(builds) == sorted(2 * expected)
    assert_same(plain(first, (0, 0, 0)), got)


@pytest.mark.parametrize("behind", [True, False])
def test_the_first_change_waits_for_nothing(device, monkeypatch, builds, behind):
    """It comes after a still start; without what is built behind the first frames it would wait."""
    if not behind:
        monkeypatch.setattr("stss_cl.skip.partial_network.PartialNetwork.expect_changes", lambda network: None)
    stream, frames = Stream(WEIGHTS, device), still(8)
    frames[6].gbuffer[3, 4] += np.float32(0.5)
    for i in range(8):
        before = len(builds)
        window = frames[max(0, i - 5) : i + 1]
        stream(window, plan(window).steps)
        if i >= 6:
            assert stream.report.network == "changed"
            assert (len(builds) == before) == (behind or i == 7)


def test_frames_older_than_the_window_are_let_go(device):
    """A frame at 1920 x 1080 out takes 40 MB."""
    stream, frames, window, seen = Stream(WEIGHTS, device), still(12, change="everything"), [], []
    while frames:
        window = [*window[-5:], frames.pop(0)]
        seen.append(weakref.ref(window[-1].gbuffer))
        stream(window, plan(window).steps)
    assert [ref() is not None for ref in seen] == 6 * [False] + 6 * [True]


@pytest.mark.parametrize("x", range(11))
def test_one_pixel_that_moves_is_seen(device, x):
    """Nothing else changes, so nothing else gives it away; in columns of whole tiles, and in the last one, which is cut off."""
    keeping, plain, frames = Stream(WEIGHTS, device), Stream(WEIGHTS, device, skip="off"), list(still(12, (9, 11)))
    frames[11].motion[5, x] = -1.75, 1.25
    for i in range(6, 12):
        window = frames[max(0, i - 5) : i + 1]
        got, want = (stream(window, plan(window).steps) for stream in (keeping, plain))
    assert_same(got, want)
    assert keeping.report.network == "changed"


def test_what_weights_do_not_read_is_not_computed(device):
    """An older colour that changes costs weights that do not read it no more than a comparison, and those that do a part of the network.

    Of frame 8 the colour is another: SFs see it come and go in frames 8 and 10, 10 and 12, and 12 and 14, as far back as they read.
    """
    frames = list(still(16))
    color = frames[8].color.copy()
    color[:2, :3] += 0.1
    frames[8] = replace(frames[8], color=color)
    for weights, last in ((UNREAD, 10), (EARLIER, 12), (WEIGHTS, 14)):
        keeping, plain = Stream(weights, device), Stream(weights, device, skip="off")
        for i in range(16):
            window = frames[max(0, i - 5) : i + 1]
            assert_same(keeping(window, plan(window).steps), plain(window, plan(window).steps))
            if i >= 8 and i % 2 == 0:
                assert keeping.report.network == ("changed" if i <= last else "none")


def test_activity_says_where(device):
    """Nothing in a still frame, everything in one computed whole; elsewhere it covers every pixel that now differs."""
    keeping, frames = Stream(WEIGHTS, device), still(14, (61, 93))
    frames[12].color[40:43, 70:74] += 0.1
    images = []
    for i in range(14):
        window = frames[max(0, i - 5) : i + 1]
        images.append(keeping(window, plan(window).steps)[0].copy())
        activity = keeping.activity()
        assert activity.shape == (16, 24)
        if i == 0:
            assert (activity == 1).all()
        elif i in (9, 10, 11):
            assert (activity == 0).all()
    assert keeping.report.network == "changed"
    assert activity.max() == activity[8:13, 15:20].max()
    assert activity.min() < 0.7 * activity.max() < 0.7  # far away only the deep layers changed
    differs = (images[13] != images[11]).any(axis=-1)
    tiles = np.add.reduceat(np.add.reduceat(differs, range(0, 122, 8), axis=0), range(0, 186, 8), axis=1) > 0
    assert tiles.any()
    assert (activity[tiles] > 0).all()


def test_where_all_changes_nothing_is_looked_for_after_a_while(device, monkeypatch):
    monkeypatch.setattr("stss_cl.skip.change_control.RULES", replace(RULES, rest=3))
    rng, frames = np.random.default_rng(2), still(1)
    color, keeping, plain = frames[0].color, Stream(WEIGHTS, device), Stream(WEIGHTS, device, skip="off")
    for i in range(1, 30):
        made, color = next_frame(rng, frames[-1], color, "everything", rendered=i % 2 == 0)
        frames.append(made)
    looks, take = [], UploadedFrames.take
    monkeypatch.setattr(
        UploadedFrames, "take", lambda self, window, *, compare: (looks.append(compare), take(self, window, compare=compare))[1]
    )
    for i in range(30):
        window = frames[max(0, i - 5) : i + 1]
        steps = plan(window).steps
        assert_same(keeping(window, steps), plain(window, steps))
        assert keeping.report.network == "whole"
    # Both streams in turns: every second look is that of the one that keeps nothing.
    assert looks[::2] == [True] * 8 + [False, False, True, True, True, True] * 3 + [False, False, True, True]


def test_a_change_that_is_not_seen_would_show(device, monkeypatch):
    """The fault planted: a map that says nothing changed."""
    frames = still(10)
    color = frames[8].color + np.float32(0.5)
    frames[8] = replace(frames[8], color=color)
    keeping, plain = Stream(WEIGHTS, device), Stream(WEIGHTS, device, skip="off")
    for i in range(8):
        window = frames[max(0, i - 5) : i + 1]
        keeping(window, plan(window).steps)
    monkeypatch.setattr(
        "stss_cl.skip.uploaded_frames.UploadedFrames.color_changed",
        lambda self, now, before: np.zeros((-(-16 // 4), -(-24 // 4)), np.bool_),
    )
    with pytest.raises(AssertionError):
        assert_same(keeping(frames[3:9], (0, 2, 4)), plain(frames[3:9], (0, 2, 4)))


@pytest.mark.parametrize("skip", ["off", "exact"])
def test_an_image_may_be_copied_to_the_callers_array(device, skip):
    """Which is then the caller's alone: what is done to it shows in no other frame."""
    stream, plain, frames = Stream(WEIGHTS, device, skip=skip), Stream(WEIGHTS, device, skip="off"), still(9, change="rectangle")
    out = np.empty((32, 48, 3), np.float32)
    for i in range(9):
        window = frames[max(0, i - 5) : i + 1]
        made, valid = stream(window, plan(window).steps, out)
        assert made is out
        assert_same((made, valid), plain(window, plan(window).steps))
        out[...] = np.nan
    for wrong in (out[1:], out.astype(np.float64), np.empty((32, 96, 3), np.float32)[:, ::2]):
        with pytest.raises(ArrayError, match="out: expected"):
            stream(frames[:5], (0, 2, 4), wrong)


def test_mistakes_name_what_is_wrong(device):
    frames, made = still(6), Stream(WEIGHTS, device)
    with pytest.raises(ArrayError, match="window: expected the 5 frames that the steps lead to, got 2"):
        made(frames[:2], (0, 2, 4))
    with pytest.raises(ArrayError, match="window: expected a colour 1, 3, 5 frames back"):
        made([replace(frame, color=None) for frame in frames], (1, 3, 5))
    broken = frames[4].gbuffer.copy()
    broken[3, 4, 5] = np.nan
    with pytest.raises(ArrayError, match="gbuffer"):
        made([*frames[:4], replace(frames[4], gbuffer=broken)], (0, 2, 4))
    plain = Stream(WEIGHTS, device, skip="off")
    assert_same(made(frames[:5], (0, 2, 4)), plain(frames[:5], (0, 2, 4)))


def test_work_groups_do_not_follow_the_size(device, monkeypatch):
    """PoCL compiles a kernel anew for every group, so a new size of frames would cost seconds."""
    groups, enqueue, call = {}, cl.enqueue_nd_range_kernel, cl.Kernel.__call__

    def note(kernel, group):
        groups.setdefault(kernel.function_name, set()).add(group)

    def enqueued(queue, kernel, size, group, *more):
        note(kernel, group)
        return enqueue(queue, kernel, size, group, *more)

    def called(kernel, queue, size, group, *arguments, **options):
        note(kernel, group)
        return call(kernel, queue, size, group, *arguments, **options)

    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", enqueued)
    monkeypatch.setattr(cl.Kernel, "__call__", called)
    found = []
    for size in ((24, 40), (37, 147)):
        frames = list(still(8, size))
        frames[6].gbuffer[3:7, 2:9] += 0.1
        for skip, weights in (("off", WEIGHTS), ("exact", WEIGHTS), ("exact", UNREAD), ("exact", EARLIER)):
            stream = Stream(weights, device, skip=skip)
            for i in range(8):
                window = frames[max(0, i - 5) : i + 1]
                stream(window, plan(window).steps)
        # Those of the packing divide a width of 8, 16, 24 .., so they are one of four.
        found.append({name: group for name, group in groups.items() if name != "finite" and not name.startswith("pack")})
        groups.clear()
    assert found[0] == found[1]
    of_class = {"attend", "normalise", "differ", "differ_color"} if device.is_cpu else {"attend_local", "arrive"}
    assert {"upsample_corners", "downsample_8"} | of_class < set(found[0])
    if device.is_cpu:
        assert not any(None in group for group in found[0].values())
