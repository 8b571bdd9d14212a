"""Planes that come as half: they are widened on the device, and everything behind that is as if they had come as float32."""

from dataclasses import replace

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest

from conformance.tolerance import ratio
from stss.frames.backends import ReferenceBackend
from stss_cl.skip.planes import HALF, Planes
from stss_cl.skip.stream import Stream
from stss_ref.arrays import ArrayError
from tests.cl.films import assert_same, calls_of, film, halve, on, weights_for
from tests.cl.test_overlap import here, right
from tests.tiers import thorough


def widened(frame_):
    """The same values in float32, by NumPy."""
    planes = {name: getattr(frame_, name) for name in HALF}
    return replace(frame_, **{name: plane.astype(np.float32) for name, plane in planes.items() if plane is not None})


@pytest.mark.parametrize(("shape", "there"), [((65536,), False), ((65536,), True), ((1,), False), ((3,), True), ((7, 37), True)])
def test_every_half_is_widened(device, shape, there):
    """All that there are, with their signs, subnormals, infinities and NaN; counts that fill no work-item."""
    half = np.arange(np.prod(shape), dtype=np.uint16).view(np.float16).reshape(shape)
    planes = Planes(device)
    buffers = planes.bring({"nov": (cla.to_device(device.queue, half) if there else half, shape)})
    host = np.empty(shape, np.float32)
    cl.enqueue_copy(planes.queue, host, buffers["nov"])
    want = half.astype(np.float32)
    number = ~np.isnan(want)
    np.testing.assert_array_equal(np.isnan(host), ~number)
    np.testing.assert_array_equal(host[number].view(np.uint32), want[number].view(np.uint32))


@pytest.mark.parametrize(
    ("skip", "where"), [thorough("exact", "host"), thorough("exact", "device"), ("off", "mixed"), ("exact", "mixed")]
)
def test_frames_of_half_have_the_bits_of_the_same_values_in_float32(device, skip, where):
    """One by one and one ahead; mixed: every third frame comes in float32, though its values are those of half."""
    frames = [halve(frame) for frame in film()]
    want = right(device, calls_of([*map(widened, frames)]))
    if where == "device":
        frames = [on(device, frame) for frame in frames]
    if where == "mixed":
        frames = [widened(frame) if i % 3 == 0 else frame for i, frame in enumerate(frames)]
    assert frames[1].gbuffer.dtype == np.float16
    stream, ahead = (Stream(weights_for(device), device, skip=skip) for _ in range(2))
    messages = set()
    for call, also, expected in zip(calls_of(frames), ahead.frames(calls_of(frames)), want, strict=True):
        assert_same(here(stream(*call)), expected)
        assert_same(here(also), expected)
        messages.add(stream.cost.network)
    assert skip == "off" or {"none", "changed", "whole"} <= messages


@pytest.mark.parametrize("precision", ["float32", thorough("half")])
def test_the_reference_takes_the_same_planes(device, precision):
    """Images are as near to its images as those of planes in float32 are."""
    stream = Stream(weights_for(device), device, precision)
    for window, steps in calls_of([halve(frame) for frame in film(["moving"] * 6)]):
        image, valid = stream(window, steps)
        want, want_valid = ReferenceBackend(weights_for(device)).compute(window, steps)
        np.testing.assert_array_equal(valid, want_valid)
        assert want.dtype == np.float32
        assert ratio(f"network.cl.{precision}", image, want.astype(np.float64)) <= 1


@pytest.mark.parametrize("there", [False, True], ids=["host", "device"])
@pytest.mark.parametrize("name", [*HALF, "motion", "position"])
def test_what_is_not_finite_in_half_and_planes_that_stay_float32_are_named(device, name, there):
    frames = [halve(frame) for frame in film(["moving"] * 4)]
    plane = getattr(frames[4], name).astype(np.float16)
    plane.reshape(-1)[77] = np.inf
    frames[4] = replace(frames[4], **{name: plane})
    planes = [on(device, frame) for frame in frames] if there else frames
    words = "1 non-finite values" if name in HALF else "expected dtype float32, got float16$"
    with pytest.raises(ArrayError, match=f"^{name}: {words}"):
        Stream(weights_for(device), device)(*calls_of(planes)[-1])
