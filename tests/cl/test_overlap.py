"""Frames of a stream one ahead: the bits of calls, and what waits for what where planes arrive and images leave meanwhile.

Nothing here depends on which of two threads is faster: a queue is held by an event of ours until something has been seen to happen, or
to not have happened after a second in which it could have.
"""

from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from contextlib import contextmanager
from dataclasses import replace
from threading import Timer

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest
from hypothesis import given, settings

from stss.frames.display_frame import window_at
from stss.frames.supersample import plan
from stss_cl.device.staging import staging
from stss_cl.skip.stream import SKIPS, Stream
from stss_ref.arrays import ArrayError
from tests.cl.test_device_frames import SIZE, film, on, stopped_before
from tests.cl.test_stream import WEIGHTS, assert_same, sequences, windows

MOMENT = 1.0
"""Seconds in which what may happen does, and what must wait is seen to."""
LONG = 120.0
"""Seconds after which what should have happened is given up."""


def calls_of(frames, first=0):
    return [(window_at(frames, i), plan(window_at(frames, i)).steps) for i in range(first, len(frames))]


def rendered(count):
    """Frames that all have a colour: each of the kind of the one before it."""
    rng, frames = np.random.default_rng(5), film(["moving"] * (count - 1))
    return [replace(frame, color=rng.random((*SIZE, 3), np.float32)) for frame in frames]


def right(device, calls):
    """What calls one by one give, to a stream that keeps nothing."""
    stream = Stream(WEIGHTS, device, skip="off")
    return [stream(*call) for call in calls]


def here(pair):
    """Copies of image and mask, wherever they lie."""
    image, valid = (array.get() if isinstance(array, cla.Array) else array.copy() for array in pair)
    return image, valid.astype(bool)


@contextmanager
def held(*queues):
    """What is put into these queues now does not begin before the end."""
    event = cl.UserEvent(queues[0].context)
    for queue in queues:
        cl.enqueue_barrier(queue, wait_for=[event])
        queue.flush()
    try:
        yield event
    finally:
        if event.command_execution_status != cl.command_execution_status.COMPLETE:
            event.set_status(cl.command_execution_status.COMPLETE)


@contextmanager
def held_for_a_moment(*queues):
    with held(*queues) as event:
        timer = Timer(MOMENT, event.set_status, [cl.command_execution_status.COMPLETE])
        timer.start()
        yield event
        timer.join()


# Bits


@pytest.mark.parametrize("there", [False, True], ids=["host", "device"])
@pytest.mark.parametrize("skip", SKIPS)
def test_frames_one_ahead_have_the_bits_of_calls(device, skip, there):
    """SF and EF in turns, of which some change nowhere, some in part and some everywhere; every image is held to the end."""
    frames = film()
    want = right(device, calls_of(frames))
    stream, plain = Stream(WEIGHTS, device, skip=skip), Stream(WEIGHTS, device, skip=skip)
    shown = [on(device, frame) for frame in frames] if there else frames
    made, copies, told = [], [], []
    for pair, call in zip(stream.frames(iter(calls_of(shown))), calls_of(shown), strict=True):
        made.append(pair)
        copies.append(here(pair))
        told.append(stream.report)
        plain(*call)
        assert told[-1] == plain.report
    for pair, copy, expected in zip(made, copies, want, strict=True):
        assert_same(copy, expected)
        assert_same(here(pair), copy)
        assert isinstance(pair[0], cla.Array) == there
    assert skip == "off" or {"none", "changed", "whole"} <= {report.network for report in told}


@settings(max_examples=10)
@given(sequence=sequences())
def test_whatever_comes_in_whatever_order(gpu, sequence):
    """Windows out of turn, repeated, cut short; images are held or not."""
    calls = list(windows(sequence))
    want = right(gpu, calls)
    for skip in SKIPS:
        stream, kept = Stream(WEIGHTS, gpu, skip=skip), []
        for i, (image, valid) in enumerate(stream.frames(calls)):
            assert_same((image, valid), want[i])
            kept += [(i, image, valid)] if i % 3 else []
        for i, image, valid in kept:
            assert_same((image, valid), want[i])


def test_calls_are_taken_one_ahead(gpu):
    """And no further: a caller that makes frames as it goes needs memory for one more."""
    taken, calls = [], calls_of(film()[:5])
    for i, _ in enumerate(Stream(WEIGHTS, gpu).frames((taken.append(0), call)[1] for call in calls)):
        assert len(taken) == min(i + 2, 5)


@pytest.mark.parametrize("skip", SKIPS)
def test_calls_may_come_between(gpu, skip):
    """Of frames that the iterator has begun, and of others."""
    calls = calls_of(film())
    stream, want = Stream(WEIGHTS, gpu, skip=skip), right(gpu, calls)
    for i, made in enumerate(stream.frames(calls)):
        between = (i * 3) % len(calls)
        assert_same(stream(*calls[between]), want[between])
        assert_same(made, want[i])


# Errors, and leaving early


def broken(frame, how):
    if how == "NaN":
        nov = frame.nov.copy()
        nov[3, 4] = np.nan
        return replace(frame, nov=nov)
    return replace(frame, position=frame.position[1:])


@pytest.mark.parametrize("looking", [True, False])
@pytest.mark.parametrize("skip", SKIPS)
@pytest.mark.parametrize("how", ["NaN", "shape", "caller"])
def test_an_error_comes_in_its_turn(gpu, how, skip, looking):
    """After all frames before it, and with nothing for its own; the stream goes on with the frames that are right."""
    frames = film(["moving"] * 9)
    calls, want = calls_of(frames), right(gpu, calls_of(frames))
    stream = Stream(WEIGHTS, gpu, skip=skip)
    stream._control.frames_unlooked = 0 if looking else 100
    bad = [*frames[:6], broken(frames[6], how), *frames[7:]]

    def given_calls():
        yield from calls[:6] if how == "caller" else calls_of(bad)
        raise ArrayError("nov: told by the caller")

    made = []
    with pytest.raises(ArrayError, match="position: expected" if how == "shape" else "nov:"):
        made.extend(here(pair) for pair in stream.frames(given_calls()))
    assert len(made) == 6
    made += [here(pair) for pair in stream.frames(calls[6:])]
    for got, expected in zip(made, want, strict=True):
        assert_same(got, expected)


def test_leaving_early_waits_for_what_was_begun(gpu):
    """Its page-locked memory serves again."""
    calls = calls_of(film(["moving"] * 4))
    ahead = Stream(WEIGHTS, gpu).frames(calls)
    next(ahead)
    next(ahead)
    with held_for_a_moment(staging(gpu).downloads) as event:
        next(ahead)  # the third, while the image of the fourth cannot leave
        assert event.command_execution_status != cl.command_execution_status.COMPLETE
        ahead.close()
        assert event.command_execution_status == cl.command_execution_status.COMPLETE


# What waits for what


def begun(stream, calls):
    """The first ones of a stream that compares nothing are computed, so that it has its memory and its kernels."""
    stream._control.frames_unlooked = 100
    for call in calls:
        stream(*call)
    return stream


@pytest.mark.parametrize("last", [3, 8])
@pytest.mark.parametrize("skip", SKIPS)
def test_a_frame_arrives_while_the_one_before_it_is_computed_and_no_earlier(gpu, monkeypatch, skip, last):
    """The rule: planes of n + 1 arrive while the launches of n stand still; those of n + 2 wait for them, if memory serves again."""
    frames = film(["moving"] * 10)
    calls, want = calls_of(frames), right(gpu, calls_of(frames))
    stream = begun(Stream(WEIGHTS, gpu, skip=skip), calls[:last])
    stop = stopped_before(monkeypatch, gpu, "conv")
    with ThreadPoolExecutor(1) as caller:
        try:
            first, second = (caller.submit(stream._begin, *call).result(timeout=LONG) for call in calls[last : last + 2])
            staging(gpu).uploads.finish()
            drops = last + 1 > 5  # before, all windows begin with the first frame
            third = caller.submit(stream._begin, *calls[last + 2]) if last + 2 < len(calls) else None
            if third is not None and drops:
                with pytest.raises(NotYet):
                    third.result(timeout=MOMENT)
            elif third is not None:
                third.result(timeout=LONG)
        finally:
            stop.set_status(cl.command_execution_status.COMPLETE)
        made = [first, second] + ([third.result(timeout=LONG)] if third is not None else [])
    for i, each in enumerate(made, start=last):
        assert_same(each.finish(), want[i])


@pytest.mark.parametrize("skip", SKIPS)
def test_planes_dropped_at_a_jump_are_read_to_the_end(gpu, monkeypatch, skip):
    """Where frames do not follow those before them, all planes are dropped at once, while launches may still read them."""
    frames, others = film(["moving"] * 7), film(["moving"] * 8)[::-1][:7]
    others = [replace(frame, number=i, color=frames[i].color) for i, frame in enumerate(others)]
    calls, jumped = calls_of(frames), calls_of(others)[-1]
    want = right(gpu, [calls[-1], jumped])
    stream = begun(Stream(WEIGHTS, gpu, skip=skip), calls[:-1])
    stop = stopped_before(monkeypatch, gpu, "chain")  # an EF: the first kernel that reads planes
    with ThreadPoolExecutor(1) as caller:
        try:
            first = stream._begin(*calls[-1])
            second = caller.submit(stream._begin, *jumped)
            with pytest.raises(NotYet):
                second.result(timeout=MOMENT)
        finally:
            stop.set_status(cl.command_execution_status.COMPLETE)
        made = [first.finish(), second.result(timeout=LONG).finish()]
    for got, expected in zip(made, want, strict=True):
        assert_same(got, expected)


def test_planes_have_memory_that_is_never_anything_else(gpu):
    """Other memory is reused in the order of the launches, for which planes do not wait."""
    calls = calls_of(film()[:4])
    stream = begun(Stream(WEIGHTS, gpu), calls[:2])
    content = np.arange(SIZE[0] * SIZE[1], dtype=np.float32).reshape(SIZE)  # as large as a plane
    here, there = (cla.to_device(gpu.queue, content, allocator=gpu.pool) for _ in range(2))
    there.fill(0)
    gpu.queue.finish()
    with held(gpu.queue):
        cl.enqueue_copy(gpu.queue, there.base_data, here.base_data)
        del here
        made = stream._begin(*calls[2])
    made.finish()
    np.testing.assert_array_equal(there.get(), content)


@pytest.mark.parametrize("queue", ["uploads", "downloads", "launches"])
@pytest.mark.parametrize("looking", [True, False])
@pytest.mark.parametrize("skip", SKIPS)
def test_a_frame_is_whole_however_late_a_queue_is(gpu, skip, looking, queue):
    """Launches wait for what arrives, the download for them, and the caller for the download."""
    frames = film(["moving"] * 8)
    calls, want = calls_of(frames), right(gpu, calls_of(frames))
    stream = begun(Stream(WEIGHTS, gpu, skip=skip), calls[:7])
    stream._control.frames_unlooked = 0 if looking else 100
    made = staging(gpu)
    with held_for_a_moment({"uploads": made.uploads, "downloads": made.downloads, "launches": gpu.queue}[queue]):
        for i in (7, 8):
            assert_same(here(stream(*calls[i])), want[i])


@pytest.mark.parametrize("skip", SKIPS)
def test_nothing_is_written_where_something_still_leaves(gpu, skip):
    """Two frames of a kind: image and mask of the first leave while the second is computed."""
    frames = rendered(10)
    calls, want = calls_of(frames), right(gpu, calls_of(frames))
    stream = begun(Stream(WEIGHTS, gpu, skip=skip), calls[:7])
    with held(staging(gpu).downloads):
        made = [stream._begin(*call) for call in calls[7:9]]
        gpu.queue.finish()
    for got, expected in zip(made, want[7:9], strict=True):
        assert_same(got.finish(), expected)


@pytest.mark.parametrize("looking", [True, False])
def test_what_an_engine_enqueues_is_waited_for(gpu, looking):
    """It writes its planes in the queue of the launches, and gives no events."""
    frames = film(["moving"] * 7)
    theirs, wanted = [on(gpu, frame) for frame in frames], right(gpu, calls_of(frames)[-1:])[0]
    stream = begun(Stream(WEIGHTS, gpu), calls_of(theirs)[:-1])
    stream._control.frames_unlooked = 0 if looking else 100
    late = theirs[-1].nov
    right_nov = late.copy()
    late.fill(np.nan)
    gpu.queue.finish()
    with held_for_a_moment(gpu.queue):
        cl.enqueue_copy(gpu.queue, late.data, right_nov.data)
        made = here(stream(*calls_of(theirs)[-1]))
    assert_same(made, wanted)


def test_a_mask_leaves_from_memory_of_its_own(gpu):
    """The next frame's mask is another; the one that was handed out stays."""
    frames = film(["moving"] * 10)
    calls, want = calls_of(frames), right(gpu, calls_of(frames))
    assert (want[7][1] != want[9][1]).any()
    stream = begun(Stream(WEIGHTS, gpu), calls[:7])
    with held(staging(gpu).downloads):
        made = [stream._begin(*call) for call in calls[7:10]]
        gpu.queue.finish()
    for got, expected in zip(made, want[7:10], strict=True):
        assert_same(got.finish(), expected)
