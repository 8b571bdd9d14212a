"""Display frames that an engine has on the device, and when a GPU's host code waits for anything."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import partial
from threading import Timer

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest

from stss.frames.display_frame import window_at
from stss.frames.supersample import plan
from stss_cl.device.discovery import open_device
from stss_cl.device.staging import staging
from stss_cl.skip.stream import Stream
from stss_ref.arrays import ArrayError
from tests.cl.test_stream import WEIGHTS, first_frame, next_frame

SIZE = 24, 40
CHANGES = (*5 * ["nothing"], "nothing", "pixel", "moving", "nothing", "rectangle")


def film(changes=CHANGES):
    rng = np.random.default_rng(4)
    frames = [first_frame(rng, SIZE, rendered=True)]
    color = frames[0].color
    for i, change in enumerate(changes, start=1):
        frame, color = next_frame(rng, frames[-1], color, change, rendered=i % 2 == 0)
        frames.append(frame)
    return frames


def on(device, frame):
    """The same frame on the device, as an engine's buffers wrapped into arrays."""
    held = {}
    for name in (field.name for field in fields(frame) if field.name not in ("number", "carried")):
        array = getattr(frame, name)
        if array is not None:
            buffer = cl.Buffer(device.context, cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR, hostbuf=array)
            held[name] = cla.Array(device.queue, array.shape, np.float32, data=buffer)
    return replace(frame, **held)


@pytest.mark.parametrize("skip", ["off", "exact"])
def test_frames_on_the_device_give_the_same_bits(device, skip):
    frames = film()
    theirs = [on(device, frame) for frame in frames]
    here, there = (Stream(WEIGHTS, device, skip=skip) for _ in range(2))
    out = cla.empty(device.queue, (2 * SIZE[0], 2 * SIZE[1], 3), np.float32)
    told = []
    for i in range(len(frames)):
        steps = plan(window_at(frames, i)).steps
        image, valid = here(window_at(frames, i), steps)
        made, mask = there(window_at(theirs, i), steps, out if i % 2 else None)
        assert isinstance(made, cla.Array)
        assert (made is out) == bool(i % 2)
        np.testing.assert_array_equal(made.get().view(np.uint32), image.view(np.uint32))
        np.testing.assert_array_equal(mask.get().astype(bool), valid)
        told.append(there.report.network)
        assert told[-1] == here.report.network
    assert skip == "off" or {"none", "changed", "whole"} <= set(told)


def test_frames_may_lie_here_and_there(device):
    frames = film(["moving"] * 6)
    theirs = [on(device, frame) for frame in frames]
    mixed = [replace(frame, gbuffer=other.gbuffer, color=other.color) for frame, other in zip(frames, theirs, strict=True)]
    steps = plan(window_at(frames, 6)).steps
    image, _ = Stream(WEIGHTS, device)(window_at(frames, 6), steps)
    out = np.empty_like(image)
    made, _ = Stream(WEIGHTS, device)(window_at(mixed, 6), steps, out)
    assert made is out
    np.testing.assert_array_equal(out.view(np.uint32), image.view(np.uint32))


def wrong(device, name):
    queue, other = device.queue, cl.Context([device.handle])
    elsewhere = cl.Buffer(other, cl.mem_flags.READ_WRITE, 4 * SIZE[0] * SIZE[1])
    small = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 4 * SIZE[0] * SIZE[1] - 4)
    return {
        "shape": cla.zeros(queue, (SIZE[0], SIZE[1] + 1), np.float32),
        "dtype": cla.zeros(queue, SIZE, np.float64),
        "context": cla.Array(queue, SIZE, np.float32, data=elsewhere),
        "buffer": cla.Array(queue, SIZE, np.float32, data=small),
    }[name]


@pytest.mark.parametrize("name", ["shape", "dtype", "context", "buffer"])
def test_errors_name_the_plane(device, name):
    frames = film(["nothing"] * 5)
    window = [*frames[:-1], replace(frames[-1], stencil=wrong(device, name))]
    with pytest.raises(ArrayError, match="stencil: expected") as told:
        Stream(WEIGHTS, device)(window, plan(window).steps)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("skip", ["off", "exact"])
@pytest.mark.parametrize("there", [False, True], ids=["host", "device"])
def test_what_is_not_finite_is_named_and_leaves_nothing(device, skip, there):
    frames = film(["moving"] * 8)
    broken = replace(frames[7], nov=frames[7].nov.copy())
    broken.nov[3, 4] = np.nan
    stream, fresh = Stream(WEIGHTS, device, skip=skip), Stream(WEIGHTS, device, skip="off")
    stream._control.frames_unlooked = 100  # nobody waits for what is found on arrival
    shown = [on(device, frame) for frame in (*frames, broken)] if there else [*frames, broken]
    stream(shown[:7][-6:], plan(frames[1:7]).steps)
    with pytest.raises(ArrayError, match="nov:"):
        stream([*shown[2:7], shown[-1]], plan(frames[2:8]).steps)
    image, _ = stream(shown[2:8], plan(frames[2:8]).steps)
    want, _ = fresh(frames[2:8], plan(frames[2:8]).steps)
    np.testing.assert_array_equal(image.get() if there else image, want)


@pytest.mark.parametrize("skip", ["off", "exact"])
@pytest.mark.parametrize("which", [0, 1, 5])
def test_what_is_not_finite_is_named_in_any_frame_of_a_first_window(device, skip, which):
    """On a GPU nobody waits for what is found of the first, which is compared with none; the next ones are."""
    frames = film(["moving"] * 5)
    broken = replace(frames[which], gbuffer=frames[which].gbuffer.copy())
    broken.gbuffer[3, 4, 5] = np.nan
    stream, steps = Stream(WEIGHTS, device, skip=skip), plan(frames).steps
    with pytest.raises(ArrayError, match="gbuffer: 1 non-finite"):
        stream([*frames[:which], broken, *frames[which + 1 :]], steps)
    np.testing.assert_array_equal(stream(frames, steps)[0], Stream(WEIGHTS, device, skip="off")(frames, steps)[0])


class Waits:
    """Notes every call that waits for the queue in which frames are computed, and which of them brought the image."""

    def __init__(self, monkeypatch, image_bytes, queue):
        self.before_the_image, self._seen = [], False
        copy, map_buffer, note = cl.enqueue_copy, cl.enqueue_map_buffer, self._note

        def copied(queue, dest, src, **options):
            self._seen |= getattr(dest, "nbytes", 0) == image_bytes
            if any(isinstance(each, np.ndarray) for each in (dest, src)) and options.get("is_blocking", True):
                note("copy")
            return copy(queue, dest, src, **options)

        class Noted(cl.Buffer):
            def __init__(self, context, flags, size=0, hostbuf=None):
                if hostbuf is not None:
                    note("buffer")
                super().__init__(context, flags, size, hostbuf)

        def mapped(where, *arguments, **options):
            if where == queue:
                note("map")
            return map_buffer(where, *arguments, **options)

        monkeypatch.setattr(cl, "enqueue_copy", copied)
        monkeypatch.setattr(cl, "enqueue_map_buffer", mapped)
        monkeypatch.setattr(cl, "Buffer", Noted)
        for home, name in ((cl, "wait_for_events"), (cl.CommandQueue, "finish"), (cl.Event, "wait")):
            monkeypatch.setattr(home, name, self._noting(name, getattr(home, name)))

    def _noting(self, name, call):
        def noted(*arguments, **options):
            self._note(name)
            return call(*arguments, **options)

        return noted

    def _note(self, name):
        if not self._seen:
            self.before_the_image.append(name)


@pytest.mark.parametrize(("skip", "looking", "waits"), [("off", False, 0), ("exact", False, 0), ("exact", True, 2)])
def test_nobody_waits_before_the_image(gpu, monkeypatch, skip, looking, waits):
    """Of a frame among others: nowhere where none are compared, else for what arrived and what then differs."""
    device, frames = gpu, film(["moving"] * 11)
    stream = Stream(WEIGHTS, device, skip=skip)
    stream._control.frames_unlooked = 0 if looking else 100
    windows = [(window_at(frames, i), plan(window_at(frames, i)).steps) for i in range(len(frames))]
    for window, steps in windows[:-1]:
        stream(window, steps)
    for pieces in staging(device)._free.values():
        pieces.clear()  # as where all copies are still on their way
    noted = Waits(monkeypatch, 48 * SIZE[0] * SIZE[1], device.queue)
    image, _ = stream(*windows[-1])
    monkeypatch.undo()
    assert len(noted.before_the_image) == waits, noted.before_the_image
    np.testing.assert_array_equal(image, Stream(WEIGHTS, device, skip="off")(*windows[-1])[0])


@pytest.mark.parametrize("skip", ["off", "exact"])
def test_frames_on_the_device_do_not_wait_for_the_network(gpu, monkeypatch, skip):
    """The call is over while the network stands still."""
    device = gpu
    frames = [on(device, frame) for frame in film(["moving"] * 7)]
    stream, windows = streaming(device, frames, skip)
    held = stopped_before(monkeypatch, device, "conv")
    with ThreadPoolExecutor(1) as caller:
        try:
            image, _ = caller.submit(stream, *windows[-1]).result(timeout=120)
        finally:
            held.set_status(cl.command_execution_status.COMPLETE)
    monkeypatch.undo()
    whole, _ = Stream(WEIGHTS, device, skip="off")(*windows[-1])
    np.testing.assert_array_equal(image.get(), whole.get())


@pytest.mark.parametrize("skip", ["off", "exact"])
def test_they_wait_for_what_is_found_on_arrival(gpu, monkeypatch, skip):
    """Even where the look comes late."""
    device, frames = gpu, film(["moving"] * 7)
    frames[-1].nov[3, 4] = np.inf
    stream, windows = streaming(device, [on(device, frame) for frame in frames], skip)
    held = stopped_before(monkeypatch, device, "arrive")
    Timer(0.5, held.set_status, [cl.command_execution_status.COMPLETE]).start()
    with pytest.raises(ArrayError, match="nov:"):
        stream(*windows[-1])


def streaming(device, frames, skip):
    """A stream that has computed all windows but the last, and compares none; all windows with their steps."""
    stream = Stream(WEIGHTS, device, skip=skip)
    stream._control.frames_unlooked = 100
    windows = [(window_at(frames, i), plan(window_at(frames, i)).steps) for i in range(len(frames))]
    for window, steps in windows[:-1]:
        stream(window, steps)
    device.queue.finish()
    return stream, windows


def stopped_before(monkeypatch, device, name):
    """An event that the queue waits for, from now on, before the first kernel whose name begins so."""
    held, launch, call = cl.UserEvent(device.context), cl.enqueue_nd_range_kernel, cl.Kernel.__call__
    waiting = []

    def stop(queue, kernel):
        if not waiting and kernel.function_name.startswith(name):
            waiting.append(cl.enqueue_barrier(queue, wait_for=[held]))

    def launched(queue, kernel, *arguments, **options):
        stop(queue, kernel)
        return launch(queue, kernel, *arguments, **options)

    def called(kernel, queue, *arguments, **options):
        stop(queue, kernel)
        return call(kernel, queue, *arguments, **options)

    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", launched)
    monkeypatch.setattr(cl.Kernel, "__call__", called)
    return held


def test_page_locked_memory_serves_again():
    made = staging(open_device(device_class="gpu"))
    take = partial(made.array, (3, 5), np.dtype(np.float32))
    first = take()
    view = first[1:]
    place = first.ctypes.data
    del first
    assert take().ctypes.data != place
    del view
    assert place in {take().ctypes.data for _ in range(3)}
