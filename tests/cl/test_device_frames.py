"""Display frames that an engine has on the device."""

import threading
from dataclasses import replace

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest

from stss.frames.display_frame import schedule_of
from stss_cl.skip import stream
from stss_cl.skip.frames_in_flight import FrameInFlight
from stss_cl.skip.stream import Stream
from stss_cl.skip.uploaded_frames import UploadedFrames
from stss_ref.arrays import ArrayError
from tests.cl.films import SIZE, assert_same, calls_of, film, on, weights_for


@pytest.mark.parametrize("there", [False, True])
def test_frames_may_lie_here_and_there(device, there):
    frames = film(["moving"] * 6)
    theirs = [on(device, frame) for frame in frames]
    mixed = [replace(frame, gbuffer=other.gbuffer, color=other.color) for frame, other in zip(frames, theirs, strict=True)]
    image, valid = Stream(weights_for(device), device)(*calls_of(frames)[6])
    out = cla.empty(device.queue, image.shape, np.float32) if there else np.empty_like(image)
    result, mask = Stream(weights_for(device), device)(*calls_of(mixed)[6], out)
    assert result is out
    assert_same((out.get(), mask.get().astype(bool)) if there else (out, mask), (image, valid))


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
    frames[-1] = replace(frames[-1], stencil=wrong(device, name))
    with pytest.raises(ArrayError, match="stencil: expected") as error:
        Stream(weights_for(device), device)(*calls_of(frames)[-1])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("skip", "there"), [("off", True), ("exact", False), ("exact", True)])
def test_what_is_not_finite_is_named_and_leaves_nothing(device, skip, there):
    frames = film(["moving"] * 8)
    broken = replace(frames[7], nov=frames[7].nov.copy())
    broken.nov[3, 4] = np.nan
    stream, fresh = Stream(weights_for(device), device, skip=skip), Stream(weights_for(device), device, skip="off")
    stream.control.frames_unlooked = 100  # nobody waits for what is found on arrival
    planes = [on(device, frame) for frame in (*frames, broken)] if there else [*frames, broken]
    stream(planes[:7][-6:], schedule_of(frames[1:7]).steps)
    with pytest.raises(ArrayError, match="nov:"):
        stream([*planes[2:7], planes[-1]], schedule_of(frames[2:8]).steps)
    image, _ = stream(planes[2:8], schedule_of(frames[2:8]).steps)
    want, _ = fresh(frames[2:8], schedule_of(frames[2:8]).steps)
    np.testing.assert_array_equal(image.get() if there else image, want)


@pytest.mark.parametrize("which", [0, 5])
def test_what_is_not_finite_is_named_in_any_frame_of_a_first_window(device, which):
    """On a GPU nobody waits for what is found of the first, which is compared with none; the next ones are."""
    frames = film(["moving"] * 5)
    broken = replace(frames[which], gbuffer=frames[which].gbuffer.copy())
    broken.gbuffer[3, 4, 5] = np.nan
    stream, steps = Stream(weights_for(device), device), schedule_of(frames).steps
    with pytest.raises(ArrayError, match="gbuffer: 1 non-finite"):
        stream([*frames[:which], broken, *frames[which + 1 :]], steps)
    np.testing.assert_array_equal(stream(frames, steps)[0], Stream(weights_for(device), device, skip="off")(frames, steps)[0])


@pytest.fixture
def gate(device):
    """``gate()`` holds up the queue for a while; ``gate.event`` is over when it opens."""
    if not device.is_cpu:
        pytest.skip("memory of the host is copied")
    event = cl.UserEvent(device.context)

    def close():
        cl.enqueue_barrier(device.queue, wait_for=[event])
        threading.Timer(0.2, event.set_status, [cl.command_execution_status.COMPLETE]).start()

    close.is_open = lambda: event.command_execution_status == cl.command_execution_status.COMPLETE
    return close


@pytest.mark.parametrize("skip", ["off", "exact"])
def test_a_frame_on_a_processor_is_complete_when_it_is_returned(device, gate, monkeypatch, skip):
    """Its commands use memory of the host, which is freed with the stream and with frames of the caller's."""
    frames = film(["moving"] * 6)

    def begun(*values):
        gate()
        return FrameInFlight(*values)

    monkeypatch.setattr(stream, "FrameInFlight", begun)
    window, steps = calls_of([on(device, frame) for frame in frames])[6]
    Stream(weights_for(device), device, skip=skip)(window, steps)
    assert gate.is_open()


def test_no_command_is_left_behind_an_error(device, gate, monkeypatch):
    def take(*_, **__):
        gate()
        raise ArrayError("nov: wrong")

    monkeypatch.setattr(UploadedFrames, "take", take)
    with pytest.raises(ArrayError, match="nov"):
        Stream(weights_for(device), device)(*calls_of(film(["nothing"] * 6))[6])
    assert gate.is_open()
