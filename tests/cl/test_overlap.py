"""Frames of a stream one ahead: the bits of single calls, and the order of uploads, launches and downloads.

Nothing here depends on which of two threads is faster: a queue is held by an event of ours until something has been seen to happen, or
to not have happened after a moment in which it could have.
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

from stss_cl.device.staging import staging
from stss_cl.options import SKIPS
from stss_cl.skip.stream import Stream
from stss_ref.arrays import ArrayError
from tests.cl.conftest import watch_launches
from tests.cl.films import SHIPPED, assert_same, calls_of, film, on, weights_for
from tests.cl.test_stream import sequences
from tests.tiers import thorough

MOMENT = 0.5
"""Seconds in which what may happen does, and what must wait is seen to."""
LONG = 120.0
"""Seconds after which an expected event counts as missing."""


def right(device, calls):
    """The results of single calls, by a stream that keeps nothing."""
    stream = Stream(weights_for(device), device, skip="off")
    return [stream(*call) for call in calls]


def here(pair):
    """Copies of image and mask, wherever they lie."""
    image, valid = (array.get() if isinstance(array, cla.Array) else array.copy() for array in pair)
    return image, valid.astype(bool)


@contextmanager
def hold(*queues):
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
    with hold(*queues) as event:
        timer = Timer(MOMENT, event.set_status, [cl.command_execution_status.COMPLETE])
        timer.start()
        yield event
        timer.join()


# Bits


@pytest.mark.parametrize(("skip", "there"), [("off", False), ("exact", False), ("exact", True)])
def test_frames_one_ahead_have_the_bits_of_calls(device, skip, there):
    """SF and EF in turns, of which some change nowhere, some in part and some everywhere; every image is held to the end."""
    frames = film()
    want = right(device, calls_of(frames))
    stream, plain = Stream(weights_for(device), device, skip=skip), Stream(weights_for(device), device, skip=skip)
    planes = [on(device, frame) for frame in frames] if there else frames
    outputs, copies, messages = [], [], []
    for pair, call in zip(stream.frames(iter(calls_of(planes))), calls_of(planes), strict=True):
        outputs.append(pair)
        copies.append(here(pair))
        messages.append(stream.cost)
        plain(*call)
        assert messages[-1] == plain.cost
    for pair, copy, expected in zip(outputs, copies, want, strict=True):
        assert_same(copy, expected)
        assert_same(here(pair), copy)
        assert isinstance(pair[0], cla.Array) == there
    assert skip == "off" or {"none", "changed", "whole"} <= {report.network for report in messages}


@settings(max_examples=6)
@given(calls=sequences())
def test_whatever_comes_in_whatever_order(gpu, calls):
    """Windows out of turn, repeated, cut short; images are held or not."""
    want = right(gpu, calls)
    for skip in SKIPS:
        stream, images = Stream(SHIPPED, gpu, skip=skip), []
        for i, (image, valid) in enumerate(stream.frames(calls)):
            assert_same((image, valid), want[i])
            images += [(i, image, valid)] if i % 3 else []
        for i, image, valid in images:
            assert_same((image, valid), want[i])


def test_calls_are_taken_one_ahead(gpu):
    """And no further: a caller that makes frames as it goes needs memory for one more."""
    frames_taken, calls = [], calls_of(film()[:5])
    for i, _ in enumerate(Stream(SHIPPED, gpu).frames((frames_taken.append(0), call)[1] for call in calls)):
        assert len(frames_taken) == min(i + 2, 5)


def test_calls_may_come_between(gpu):
    """Of frames that the iterator has begun, and of others."""
    calls = calls_of(film())
    stream, want = Stream(SHIPPED, gpu), right(gpu, calls)
    for i, output in enumerate(stream.frames(calls)):
        between = (i * 3) % len(calls)
        assert_same(stream(*calls[between]), want[between])
        assert_same(output, want[i])


# Errors, and leaving early


def broken(frame, how):
    if how == "NaN":
        nov = frame.nov.copy()
        nov[3, 4] = np.nan
        return replace(frame, nov=nov)
    return replace(frame, position=frame.position[1:])


@pytest.mark.parametrize(("how", "looking"), [("NaN", True), ("NaN", False), ("shape", True), ("caller", False)])
def test_an_error_comes_in_its_turn(gpu, how, looking):
    """After all frames before it, and with nothing for its own; the stream goes on with the frames that are right."""
    frames = film(["moving"] * 9)
    calls, want = calls_of(frames), right(gpu, calls_of(frames))
    stream = Stream(SHIPPED, gpu)
    stream.control.frames_unlooked = 0 if looking else 100
    bad = [*frames[:6], broken(frames[6], how), *frames[7:]]

    def given_calls():
        yield from calls[:6] if how == "caller" else calls_of(bad)
        raise ArrayError("nov: told by the caller")

    outputs = []
    with pytest.raises(ArrayError, match="position: expected" if how == "shape" else "nov:"):
        outputs.extend(here(pair) for pair in stream.frames(given_calls()))
    assert len(outputs) == 6
    outputs += [here(pair) for pair in stream.frames(calls[6:])]
    for got, expected in zip(outputs, want, strict=True):
        assert_same(got, expected)


def test_leaving_early_waits_for_what_was_begun(gpu):
    """Its page-locked memory serves again."""
    calls = calls_of(film(["moving"] * 4))
    ahead = Stream(SHIPPED, gpu).frames(calls)
    next(ahead)
    next(ahead)
    with held_for_a_moment(staging(gpu).downloads) as event:
        next(ahead)  # the third, while the image of the fourth cannot leave
        assert event.command_execution_status != cl.command_execution_status.COMPLETE
        ahead.close()
        assert event.command_execution_status == cl.command_execution_status.COMPLETE


# What waits for what


def begin_all(stream, calls):
    """The first ones of a stream that compares nothing are computed, so that it has its memory and its kernels."""
    stream.control.frames_unlooked = 100
    for call in calls:
        stream(*call)
    return stream


def stopped_before(monkeypatch, device, name):
    """An event that the queue waits for, from now on, before the first kernel whose name begins so."""
    stop, waiting = cl.UserEvent(device.context), []

    def note(queue, kernel, group):
        if not waiting and kernel.function_name.startswith(name):
            waiting.append(cl.enqueue_barrier(queue, wait_for=[stop]))

    device.queue.finish()
    watch_launches(monkeypatch, note)
    return stop


@pytest.mark.parametrize("skip", SKIPS)
def test_frames_on_the_device_do_not_wait_for_the_network(gpu, monkeypatch, skip):
    """The call is over while the network stands still."""
    calls = calls_of([on(gpu, frame) for frame in film(["moving"] * 7)])
    stream, want = begin_all(Stream(SHIPPED, gpu, skip=skip), calls[:-1]), here(right(gpu, calls[-1:])[0])
    stop = stopped_before(monkeypatch, gpu, "conv")
    with ThreadPoolExecutor(1) as caller:
        try:
            output = caller.submit(stream, *calls[-1]).result(timeout=LONG)
        finally:
            stop.set_status(cl.command_execution_status.COMPLETE)
    assert_same(here(output), want)


@pytest.mark.parametrize("skip", SKIPS)
def test_they_wait_for_what_is_found_on_arrival(gpu, monkeypatch, skip):
    """Even where the look comes late."""
    frames = film(["moving"] * 7)
    frames[-1].nov[3, 4] = np.inf
    calls = calls_of([on(gpu, frame) for frame in frames])
    stream = begin_all(Stream(SHIPPED, gpu, skip=skip), calls[:-1])
    stop = stopped_before(monkeypatch, gpu, "arrive")
    Timer(MOMENT, stop.set_status, [cl.command_execution_status.COMPLETE]).start()
    with pytest.raises(ArrayError, match="nov:"):
        stream(*calls[-1])


@pytest.mark.parametrize(("skip", "last"), [("off", 8), ("exact", 3), ("exact", 8)])
def test_a_frame_arrives_while_the_one_before_it_is_computed_and_no_earlier(gpu, monkeypatch, skip, last):
    """The rule: planes of n + 1 arrive while the launches of n stand still; those of n + 2 wait for them, if memory serves again."""
    frames = film(["moving"] * 10)
    calls, want = calls_of(frames), right(gpu, calls_of(frames))
    stream = begin_all(Stream(SHIPPED, gpu, skip=skip), calls[:last])
    stop = stopped_before(monkeypatch, gpu, "conv")
    with ThreadPoolExecutor(1) as caller:
        try:
            first, second = (caller.submit(stream.begin, *call).result(timeout=LONG) for call in calls[last : last + 2])
            staging(gpu).uploads.finish()
            drops = last + 1 > 5  # before, all windows begin with the first frame
            third = caller.submit(stream.begin, *calls[last + 2]) if last + 2 < len(calls) else None
            if third is not None and drops:
                with pytest.raises(NotYet):
                    third.result(timeout=MOMENT)
            elif third is not None:
                third.result(timeout=LONG)
        finally:
            stop.set_status(cl.command_execution_status.COMPLETE)
        outputs = [first, second] + ([third.result(timeout=LONG)] if third is not None else [])
    for i, each in enumerate(outputs, start=last):
        assert_same(each.finish(), want[i])


@pytest.mark.parametrize("queue", ["uploads", "downloads", "launches"])
@pytest.mark.parametrize("looking", [True, thorough(False)])
def test_a_frame_is_whole_however_late_a_queue_is(gpu, looking, queue):
    """Launches wait for what arrives, the download for them, and the caller for the download."""
    frames = film(["moving"] * 8)
    calls, want = calls_of(frames), right(gpu, calls_of(frames))
    stream = begin_all(Stream(SHIPPED, gpu), calls[:7])
    stream.control.frames_unlooked = 0 if looking else 100
    pool = staging(gpu)
    with held_for_a_moment({"uploads": pool.uploads, "downloads": pool.downloads, "launches": gpu.queue}[queue]):
        for i in (7, 8):
            assert_same(here(stream(*calls[i])), want[i])


@pytest.mark.parametrize("all_rendered", [False, True])
def test_nothing_is_written_where_something_still_leaves(gpu, all_rendered):
    """Images and masks of frames, of one kind or of both in turns, leave while the next ones are computed."""
    frames = film(["moving"] * 9)
    if all_rendered:
        frames = [replace(frame, color=frame.gbuffer[..., :3].copy()) for frame in frames]
    calls, want = calls_of(frames), right(gpu, calls_of(frames))
    assert all_rendered or (want[7][1] != want[9][1]).any()
    stream = begin_all(Stream(SHIPPED, gpu), calls[:7])
    with hold(staging(gpu).downloads):
        frames_begun = [stream.begin(*call) for call in calls[7:10]]
        gpu.queue.finish()
    for got, expected in zip(frames_begun, want[7:10], strict=True):
        assert_same(got.finish(), expected)


@pytest.mark.filterwarnings("ignore::pyopencl.CompilerWarning")  # Intel's compiler says that it vectorised PyOpenCL's kernel
@pytest.mark.parametrize("looking", [True, False])
def test_what_an_engine_enqueues_is_waited_for(gpu, looking):
    """It writes its planes in the queue of the launches, and gives no events."""
    frames = film(["moving"] * 7)
    theirs, want = [on(gpu, frame) for frame in frames], right(gpu, calls_of(frames)[-1:])[0]
    stream = begin_all(Stream(SHIPPED, gpu), calls_of(theirs)[:-1])
    stream.control.frames_unlooked = 0 if looking else 100
    late = theirs[-1].nov
    right_nov = late.copy()
    late.fill(np.nan)
    gpu.queue.finish()
    with held_for_a_moment(gpu.queue):
        cl.enqueue_copy(gpu.queue, late.data, right_nov.data)
        got = here(stream(*calls_of(theirs)[-1]))
    assert_same(got, want)
