"""Planes that come as half: they are widened on the device, and everything behind that is as if they had come as float32."""

from dataclasses import replace

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest

from conformance.tolerance import ratio
from stss.demo import write_demo_sequence
from stss.frames.backends import ReferenceBackend, open_backend
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import frame_inputs, prepare, window_at
from stss.frames.supersample import plan
from stss.images.color import transfer
from stss.sequence.reader import open_sequence
from stss_cl.skip.planes import HALF, Planes
from stss_cl.skip.stream import Stream
from stss_ref.arrays import ArrayError
from stss_ref.frame import FrameInputs, frame
from stss_ref.weights import astype
from tests.cl.films import WEIGHTS, assert_same, calls_of, film, halve, on
from tests.cl.test_overlap import here, right


def widened(frame_):
    """The same values in float32, by NumPy."""
    planes = {name: getattr(frame_, name) for name in HALF}
    return replace(frame_, **{name: plane.astype(np.float32) for name, plane in planes.items() if plane is not None})


@pytest.mark.parametrize(("shape", "there"), [((65536,), False), ((65536,), True), ((1,), False), ((3,), True), ((7, 37), True)])
def test_every_half_is_widened(device, shape, there):
    """All that there are, with their signs, subnormals, infinities and NaN; counts that fill no work-item."""
    half = np.arange(np.prod(shape), dtype=np.uint16).view(np.float16).reshape(shape)
    planes = Planes(device)
    found = planes.bring({"nov": (cla.to_device(device.queue, half) if there else half, shape)})
    made = np.empty(shape, np.float32)
    cl.enqueue_copy(planes.queue, made, found["nov"])
    want = half.astype(np.float32)
    number = ~np.isnan(want)
    np.testing.assert_array_equal(np.isnan(made), ~number)
    np.testing.assert_array_equal(made[number].view(np.uint32), want[number].view(np.uint32))


@pytest.mark.parametrize(("skip", "where"), [("exact", "host"), ("exact", "device"), ("off", "mixed"), ("exact", "mixed")])
def test_frames_of_half_have_the_bits_of_the_same_values_in_float32(device, skip, where):
    """One by one and one ahead; mixed: every third frame comes in float32, though its values are those of half."""
    frames = [halve(made) for made in film()]
    want = right(device, calls_of([*map(widened, frames)]))
    if where == "device":
        frames = [on(device, made) for made in frames]
    if where == "mixed":
        frames = [widened(made) if i % 3 == 0 else made for i, made in enumerate(frames)]
    assert frames[1].gbuffer.dtype == np.float16
    stream, ahead = (Stream(WEIGHTS, device, skip=skip) for _ in range(2))
    told = set()
    for call, also, expected in zip(calls_of(frames), ahead.frames(calls_of(frames)), want, strict=True):
        assert_same(here(stream(*call)), expected)
        assert_same(here(also), expected)
        told.add(stream.report.network)
    assert skip == "off" or {"none", "changed", "whole"} <= told


@pytest.mark.parametrize("precision", ["float32", "half"])
def test_the_error_is_that_of_the_rounded_planes(device, precision):
    """Against the reference in float64 of the planes as they were rounded: the rows of the table that hold for float32."""
    frames = [halve(made) for made in film(["moving"] * 6)]
    stream, weights, judged = Stream(WEIGHTS, device, precision), astype(WEIGHTS, np.float64), 0
    for window, steps in calls_of(frames):
        inputs = vars(frame_inputs(window, steps))
        exact = {name: x.astype(np.float64) if isinstance(x, np.ndarray) else x for name, x in inputs.items()}
        image, valid = stream(window, steps)
        want, want_valid = ReferenceBackend(WEIGHTS).compute(window, steps)
        np.testing.assert_array_equal(valid, want_valid)
        assert want.dtype == np.float32
        right, holes = frame(FrameInputs(**exact), weights)
        if (holes == valid).all():  # else rounding decides about a hole
            assert ratio(f"network.cl.{precision}", image, right) <= 1
            judged += 1
    assert judged >= 4


@pytest.mark.parametrize("there", [False, True], ids=["host", "device"])
@pytest.mark.parametrize("name", ["motion", "position"])
def test_motion_and_position_stay_float32(device, name, there):
    frames = film(["moving"] * 4)
    frames[4] = replace(frames[4], **{name: getattr(frames[4], name).astype(np.float16)})
    shown = [on(device, made) for made in frames] if there else frames
    with pytest.raises(ArrayError, match=f"^{name}: expected dtype float32, got float16$"):
        Stream(WEIGHTS, device)(*calls_of(shown)[-1])


@pytest.mark.parametrize("there", [False, True], ids=["host", "device"])
@pytest.mark.parametrize("name", HALF)
def test_what_is_not_finite_in_half_is_named(device, name, there):
    frames = [halve(made) for made in film(["moving"] * 4)]
    getattr(frames[4], name).reshape(-1)[77] = np.inf
    shown = [on(device, made) for made in frames] if there else frames
    with pytest.raises(ArrayError, match=f"^{name}: 1 non-finite values"):
        Stream(WEIGHTS, device)(*calls_of(shown)[-1])


def test_both_backends_take_the_same_planes(opened, tmp_path):
    """Images of the application's frames are as near to the reference's as those of planes in float32 are."""
    write_demo_sequence(tmp_path, 8, (18, 32))
    sequence = open_sequence(tmp_path / "frames", "stss")
    shown = [halve(prepare(sequence.load(n), transfer("srgb"), "scale")) for n in sequence.numbers]
    cl, ref = (open_backend(name, WEIGHTS, ComputeOptions()) for name in ("cl", "ref"))
    for i in range(len(shown)):
        window = window_at(shown, i)
        (image, valid), (want, want_valid) = (backend.compute(window, plan(window).steps) for backend in (cl, ref))
        np.testing.assert_array_equal(valid, want_valid)
        assert ratio("network.cl.float32", image, want.astype(np.float64)) <= 1
