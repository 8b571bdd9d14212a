"""Frames in strips: the plan, and the bits of the whole frame."""

import gc
import weakref

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stss_cl.device import amx
from stss_cl.device.buffers import inputs_for
from stss_cl.device.grid import ceil8
from stss_cl.frame import Frame
from stss_cl.image_space.prepare import Prepare, PrepareOptions
from stss_cl.network.layer_builder import dtype_of
from stss_cl.network.network import Network
from stss_cl.network.strips import OVERLAP, STEP, bytes_for, bytes_to_prepare, rows_within, strips
from stss_cl.skip.stream import Stream
from stss_ground.errors import DeviceError
from stss_ref.constants import HOLE_FILLS
from stss_ref.frame import frame as reference_frame
from stss_ref.weights import LAYERS, Weights
from stss_ref.weights import random as random_weights
from tests.cl.conftest import ALL_LAYERS, OFTEN
from tests.cl.films import appearing, calls_of, film, frame_inputs, network_inputs, uneven, weights_for
from tests.tiers import thorough

WIDTH = 24


@given(
    eighths=st.integers(1, 600), cut=st.integers(0, 7), steps=st.integers(1, 90), overlap=st.sampled_from(list(OVERLAP.values()))
)
def test_every_row_is_written_once_and_far_from_a_strips_edge(eighths, cut, steps, overlap):
    height = 8 * eighths
    frame_rows = height - cut
    limit = bytes_for(2 * overlap + steps * STEP + height % STEP, height, WIDTH, np.float32)
    try:
        rows = rows_within(height, WIDTH, np.float32, limit, overlap)
    except DeviceError:
        assert bytes_for(height, height, WIDTH, np.float32) > limit
        return
    assert bytes_for(rows, height, WIDTH, np.float32) <= limit or rows == height
    counts = np.zeros(frame_rows, int)
    for strip in strips(height, frame_rows, rows, overlap):
        counts[strip.top + strip.first : strip.top + strip.last] += 1
        assert strip.top % STEP == 0
        assert 0 <= strip.top <= height - rows
        assert strip.first >= (overlap if strip.top else 0)
        assert rows - strip.last >= overlap or strip.top + rows == height
    assert (counts == 1).all()


@pytest.mark.parametrize(("winograd", "reach"), [(False, 106), (True, 230)])
def test_the_overlap_covers_the_layers(winograd, reach):
    """Counted along the longest path, from the table of layers: what a rounding that tests seldom meet would need."""
    path = [x for x in LAYERS if x.component != "history" and not x.name.startswith("KEncoder") and x.kernel == 3]
    rows = sum(x.divisor * ((2 if x.divisor == 8 else 4) if winograd else 1) for x in path if x.stride == 1)
    rows += sum(x.divisor // 2 for x in path if x.stride == 2)
    rows += 8 * 2 + (8 + 4 + 2 + 1)  # the attention's window, the decoder's upsamplings, the image's
    assert rows == reach <= OVERLAP[winograd]


def test_too_small_a_limit_says_what_is_needed():
    with pytest.raises(DeviceError, match=r"memory limit: 1 MiB; frames of 960 x 4320 need at least \d+ MiB"):
        rows_within(4320, 960, np.float32, 2**20, 128)


@pytest.mark.parametrize(
    ("precision", "size", "skip"),
    [
        ("float32", (8, 8), "exact"),
        ("float32", (272, 480), "off"),
        *(thorough(p, (272, 480), "exact") for p in ("float32-direct", "half")),
    ],
)
@ALL_LAYERS
@pytest.mark.usefixtures("launched")
def test_the_limit_counts_what_is_allocated(device, monkeypatch, precision, size, skip):
    """All buffers of a stream but the caller's frames, rounded up: to whole pages, and for weights and small frames further."""
    ends = []

    class Buffer(cl.Buffer):
        def __init__(self, context, flags, size=0, hostbuf=None):
            super().__init__(context, flags, size, hostbuf=hostbuf)
            self.frame = isinstance(hostbuf, np.ndarray) and any(np.shares_memory(hostbuf, array) for array in arrays)
            ends.append(weakref.ref(self))

    frames = film(8 * ["nothing"], size)
    arrays = [getattr(frame, name) for frame in frames for name in ("motion", "gbuffer", "nov", "stencil", "position")]
    arrays += [frame.color for frame in frames if frame.color is not None]
    stream = Stream(random_weights(2), device, precision, skip=skip)
    monkeypatch.setattr(cl, "Buffer", Buffer)
    for call in calls_of(frames):
        stream(*call)
        gc.collect()
        byte_sum = sum(buffer.size for buffer in (ref() for ref in ends) if buffer is not None and not buffer.frame)
        byte_count = (2 if skip == "exact" else 1) * bytes_for(size[0], *size, dtype_of(precision), keep=skip == "exact")
        assert byte_sum <= byte_count
    slack = 2 * (2 * 8 << 20)
    assert byte_sum >= 0.7 * byte_count - slack


@pytest.mark.parametrize("hole_fill", HOLE_FILLS)
def test_the_limit_counts_the_buffers_before_the_network(device, monkeypatch, hole_fill):
    """Shipped weights fill holes by samples, which take twice the memory of a splat."""
    size, sizes = (272, 480), []

    class Buffer(cl.Buffer):
        def __init__(self, context, flags, size=0, hostbuf=None):
            super().__init__(context, flags, size, hostbuf=hostbuf)
            sizes.append(self.size)

    inputs = inputs_for(device, *size, np.dtype(np.float32))
    monkeypatch.setattr(cl, "Buffer", Buffer)
    Prepare(device, *size, PrepareOptions(hole_fill=hole_fill), inputs=inputs)
    assert sum(sizes) <= bytes_to_prepare(*size)


def test_holes_share_the_lights_of_their_own_frame_beyond_their_strip(device):
    """The filled colours in every row of a strip, its rims too, are those of the whole frame, after another frame with other holes."""
    size, tops = (128, 96), (0, 32, 64, 96)
    other, frame = (vars(frame_inputs(size, seed, **appearing(size, seed))) for seed in (1, 2))

    def fill(prepare, top):
        prepare.strip(top)
        colors = np.empty((prepare.rows, prepare.columns, 4), np.float32)
        cl.enqueue_copy(device.queue, colors, prepare.inputs.base)
        return colors

    def prepare_rows(rows, tops):
        inputs = inputs_for(device, rows, size[1], np.dtype(np.float32))
        return Prepare(device, *size, PrepareOptions(hole_fill="reshade"), inputs=inputs, tops=tops)

    whole, in_strips = prepare_rows(size[0], (0,)), prepare_rows(32, tops)
    whole.begin(**frame)
    want = fill(whole, 0)
    for each in (other, frame):
        in_strips.begin(**each)
        got = {top: fill(in_strips, top) for top in reversed(tops)}
    for top in tops:
        np.testing.assert_array_equal(got[top], want[top : top + 32])


@ALL_LAYERS
@pytest.mark.parametrize("precision", OFTEN)
def test_strips_have_the_bits_of_the_whole(device, precision):
    if precision == "bfloat16" and (why_slow := amx.missing(device)):
        pytest.skip(why_slow)
    weights, height = random_weights(2), 1221
    inputs = network_inputs((height, WIDTH))
    whole = Network(weights, device, precision)(*inputs)
    dtype = dtype_of(precision)
    limit = bytes_for(2 * OVERLAP[precision in ("float32", "half")] + 3 * STEP, ceil8(height), WIDTH, dtype)
    narrow = Network(weights, device, precision, memory_limit=limit)
    image = narrow(*inputs)
    assert len(narrow.layers(height, WIDTH).strips) > 2
    np.testing.assert_array_equal(image, whole)


@pytest.mark.parametrize("steps", [(1, 3, 5), thorough((0, 2, 4))])
def test_whole_frames_in_strips(device, steps):
    """Motion and splat reach across strips; image and holes are as without strips."""
    height = 1210
    size = height, WIDTH
    moving = np.random.default_rng(1).uniform(-150, 150, (5, *size, 2))
    inputs = frame_inputs(size, 1, steps, motions=moving, **uneven(size))
    weights = weights_for(device)
    whole, valid = Frame(weights, device)(**vars(inputs))
    limit = bytes_for(2 * OVERLAP[True] + 3 * STEP, ceil8(height), WIDTH, np.float32)
    image, valid_in_strips = Frame(weights, device, memory_limit=limit)(**vars(inputs))
    np.testing.assert_array_equal(image, whole)
    np.testing.assert_array_equal(valid_in_strips, valid)
    _, expected = reference_frame(inputs, weights)
    np.testing.assert_array_equal(valid, expected)


def test_wide_holes_at_the_edge_of_a_strip(device):
    """A hole without samples reads 64 rows away, beyond its strip too; with direct convolutions, whose strips overlap least."""
    size, weights, precision = (1210, WIDTH), Weights(random_weights(2), hole_fill="reshade"), "float32-direct"
    inputs = frame_inputs(size, 1, gbuffer=np.full((*size, 9), 0.5), **appearing(size))
    whole, valid = Frame(weights, device, precision)(**vars(inputs))
    limit = bytes_for(2 * OVERLAP[False] + 3 * STEP, ceil8(size[0]), WIDTH, np.float32)
    image, valid_in_strips = Frame(weights, device, precision, memory_limit=limit)(**vars(inputs))
    np.testing.assert_array_equal(image, whole)
    np.testing.assert_array_equal(valid_in_strips, valid)
