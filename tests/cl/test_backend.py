"""The backend of frames over OpenCL: images stay on a GPU from the network to the output."""

from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest

from stss.frames.accumulation import EARLIER, Accumulation, accumulate_arrays
from stss.frames.backends import OpenCLBackend
from stss.frames.carried_planes import HIGHLIGHTS
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import OnHost, schedule_of
from stss.frames.output import compute
from stss.images.color import transfer
from stss_cl.image_space.output import CURVE_ERROR
from stss_cl.skip.stream import Stream
from tests.cl.films import film, weights_for

UNIT = 2.0**-24
WORDS = 512
"""Bytes of numbers that steer the launches, less than any plane has."""


@pytest.fixture
def backend(device, monkeypatch):
    """With stage `accumulate`."""
    return of(device, monkeypatch)


def of(device, monkeypatch, **options):
    alone = without_accumulate(device, monkeypatch, **options)
    return Accumulation(alone, alone.accumulate)


def without_accumulate(device, monkeypatch, **options):
    monkeypatch.setattr("stss.devices.selection.choose", lambda *_, **__: device)
    return OpenCLBackend(weights_for(device), ComputeOptions(**options), print)


def bright_film():
    """Frames of which some have highlights, and all that are rendered have alpha."""
    random = np.random.default_rng(5)
    for frame in film():
        planes = {} if frame.color is None else {"alpha": random.random((*frame.nov.shape, 1), np.float32)}
        if frame.number % 4 == 0 and planes:
            planes[HIGHLIGHTS] = 9 * random.random((*frame.nov.shape, 3), np.float32)
        yield replace(frame, carried=planes)


def windows(frames):
    return [tuple(frames[max(0, n - 7) : n + 1]) for n in range(len(frames))]


@pytest.mark.parametrize("curve", ["srgb", "none"])
def test_an_output_is_what_its_stages_make_on_the_host(device, backend, curve):
    frames, alone, images = list(bright_film()), Stream(weights_for(device), device, skip="off"), []
    for window in windows(frames):
        got = compute(window, backend, transfer(curve))
        steps = schedule_of(window).steps
        image, valid = alone(window[-6:], steps)
        earlier, images = images[:EARLIER], [image, *images]
        shown = accumulate_arrays(image, earlier, [frame.motion for frame in window[::-1]][: len(earlier)]) if earlier else image
        motion = window[-1].motion if steps[0] else None
        color, carried = OnHost().deliver(shown, transfer(curve), window[-1 - steps[0]].carried, motion)
        # The share of a highlight is a quotient, which OpenCL rounds to 2.5 units in the last place; a product and a sum follow.
        assert (np.abs(got.image - color.astype(np.float64)) <= (CURVE_ERROR + 8 * UNIT) * color).all()
        np.testing.assert_array_equal(got.valid, valid)
        np.testing.assert_array_equal(got.carried["alpha"], carried["alpha"])


def test_frames_that_another_thread_pushed_out_are_mixed_too(device, monkeypatch):
    """Their motion is no longer on the device."""
    backend = without_accumulate(device, monkeypatch)
    frames, others = film(seed=1), film(seed=2)
    steps = schedule_of(frames[:4]).steps
    images = [backend.compute(tuple(frames[: n + 1]), schedule_of(frames[: n + 1]).steps)[0] for n in range(4)]
    backend.compute(tuple(others[:4]), steps)
    motions = [frame.motion for frame in frames[3:1:-1]]
    mixed = backend.accumulate(images[3], images[2:0:-1], motions)
    got, _ = backend.deliver(mixed, transfer("none"), {}, None)
    on_host = [backend.deliver(image, transfer("none"), {}, None)[0] for image in images]
    want = accumulate_arrays(on_host[3], on_host[2:0:-1], motions)
    inside = ((want > 0) & (want < 1)).all()  # what is delivered is clipped, what is mixed is not
    assert not inside or (got == want).all()


def test_a_plane_crosses_once_and_an_image_once(gpu, monkeypatch):
    """To a GPU goes what a frame brings, each plane once; to the host the output, and at most a map of changes."""
    backend, moved, copy = of(gpu, monkeypatch), [0, 0], cl.enqueue_copy

    def counted(queue, to, source, **options):
        for side, array in enumerate((source, to)):
            if isinstance(array, np.ndarray):
                moved[side] += array.nbytes
        return copy(queue, to, source, **options)

    monkeypatch.setattr(cl, "enqueue_copy", counted)
    backend.expect((24, 40))
    for window in windows(list(bright_film())):
        moved[:] = 0, 0
        output, frame = compute(window, backend, transfer("srgb")), window[-1]
        planes = [getattr(frame, name) for name in ("color", "motion", "gbuffer", "nov", "stencil", "position")]
        carried = window[-1 - schedule_of(window).steps[0]].carried
        brought = sum(plane.nbytes for plane in (*planes, *carried.values()) if plane is not None)
        shown = output.image.nbytes + output.valid.nbytes + sum(plane.nbytes for plane in output.carried.values())
        change_map = frame.nov.size  # bytes
        if backend.cost.network == "none":
            shown, change_map = shown - output.valid.nbytes, 0  # that of two frames before
        assert brought <= moved[0] <= brought + WORDS
        assert output.image.nbytes < moved[1] <= shown + change_map + WORDS
