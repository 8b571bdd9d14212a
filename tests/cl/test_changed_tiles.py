"""Computing only what changed: the bits of computing everything, no work where nothing changed, no drift where small steps are let go."""

from functools import cached_property

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from conformance.cases.planes import SEEDS, sizes
from conformance.tolerance import ratio
from stss_cl.device.buffers import incoming, padded, read
from stss_cl.device.grid import grid
from stss_cl.device.program import build
from stss_cl.device.tuning import Direct, Tuning, Winograd, trial
from stss_cl.network.layers import Layers
from stss_cl.network.network import PRECISIONS
from stss_cl.network.strips import OVERLAP
from stss_cl.skip.partial_network import PartialNetwork
from stss_ref.network import network
from stss_ref.weights import random as random_weights
from tests.cl.conftest import QUICK

few = settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
CHANGES = st.lists(st.tuples(st.sampled_from(["nothing", "pixel", "rectangle", "all", "back"]), SEEDS), min_size=1, max_size=5)


def contents(device, held):
    """Activations as (images, rows, columns, channels) with their border."""
    host = np.empty((held.images, held.rows, held.columns, held.channels), held.dtype)
    cl.enqueue_copy(device.queue, host, held.data)
    return host


def raw(device, buffer, dtype=np.uint8):
    host = np.empty(buffer.size // np.dtype(dtype).itemsize, dtype)
    cl.enqueue_copy(device.queue, host, buffer)
    return host


def bits(array):
    return array.view(np.uint16 if array.dtype.itemsize == 2 else np.uint32)


def tiles(before, after):
    """The change map between two contents."""
    differ = (bits(before) != bits(after)).any(-1)[:, 1:-1, 1:-1]
    images, rows, columns = differ.shape
    return differ.reshape(images, rows // 4, 4, columns // 4, 4).any((2, 4)).astype(np.uint8)


class Sequence:
    """Frame after frame on one set of buffers."""

    def __init__(self, device, size, precision="float32", weights=None):
        self.device, self.size, self.precision = device, size, precision
        self.weights = random_weights(5) if weights is None else weights
        self.layers = Layers(device, self.weights, *size, precision, keep=True)
        assert self.layers.keep
        self.network = PartialNetwork(self.layers)
        self.given = self.layers.inputs.input, self.layers.inputs.earlier, self.layers.inputs.eighth
        self.image = self.buffer()
        self.poison()

    def buffer(self):
        return cl.Buffer(self.device.context, cl.mem_flags.READ_WRITE, 48 * self.size[0] * self.size[1])

    def poison(self):
        cl.enqueue_fill_buffer(self.device.queue, self.image, np.float32([np.nan]), 0, self.image.size)

    def show(self, image=None):
        return raw(self.device, image or self.image, np.float32).reshape(2 * self.size[0], 2 * self.size[1], 3)

    def fill(self, inputs, layers=None):
        layers = layers or self.layers
        held = [incoming(self.device, array) for array in inputs]
        layers.pack(*held)
        self.device.queue.finish()

    def feed(self, inputs):
        """Fill the inputs and mark the tiles that now differ."""
        before, base = [contents(self.device, held) for held in self.given], self.base()
        self.fill(inputs)
        marks = [tiles(old, contents(self.device, held)) for held, old in zip(self.given, before, strict=True)]
        marks[0] |= tiles(base, self.base())  # in half precision it may differ where the input does not
        for held, marked in zip(self.given, marks, strict=True):
            self.mark(held, marked)

    def base(self):
        """The frame that is upsampled and added, with a border as activations have."""
        rows, columns = self.given[0].height, self.given[0].width
        return np.pad(
            raw(self.device, self.layers.inputs.base, np.float32).reshape(1, rows, columns, 4), ((0, 0), (1, 1), (1, 1), (0, 0))
        )

    def mark(self, held, marks):
        assert held.changes.size == marks.size
        cl.enqueue_copy(self.device.queue, held.changes, marks)

    def first(self, inputs):
        self.feed(inputs)
        self.layers.run(self.image)

    def next(self, inputs):
        self.feed(inputs)
        self.network.run_changed(self.image)

    def fresh(self, inputs):
        """The image from buffers that the layers share and launches that compute everything."""
        image = self.buffer()
        self.fill(inputs, self.plain)
        self.plain.run(image)
        return self.show(image)

    @cached_property
    def plain(self):
        made = Layers(self.device, self.weights, *self.size, self.precision)
        assert not made.keep
        return made


def noise(random, size):
    shapes = ((*size, 6), (*size, 9), size, (3, *size, 4))
    color, gbuffer, mask, history = (random.random(shape, dtype=np.float32) for shape in shapes)
    return [color, gbuffer, (mask < 0.7).astype(np.float32), history]


def step(inputs, first, kind, seed):
    """The next frame's inputs."""
    random = np.random.default_rng(seed)
    if kind == "back":
        return first
    if kind == "nothing":
        return inputs
    height, width = inputs[2].shape
    top, left = random.integers(height), random.integers(width)
    if kind == "all":
        place = np.s_[:, :]
    elif kind == "pixel":
        place = np.s_[top : top + 1, left : left + 1]
    else:
        place = np.s_[top : top + random.integers(1, height + 1), left : left + random.integers(1, width + 1)]
    made, other = [array.copy() for array in inputs], noise(random, (height, width))
    for i in np.flatnonzero(random.random(4) < 0.6):
        if i < 3:
            made[i][place] = other[i][place]
        else:
            image = random.integers(3)
            made[3][image][place] = other[3][image][place]
    return made


@pytest.mark.parametrize("precision", PRECISIONS)
@few
@given(size=sizes(72), changes=CHANGES, seed=SEEDS)
def test_the_image_is_that_of_computing_everything(device, precision, size, changes, seed):
    sequence = Sequence(device, size, precision)
    inputs = first = noise(np.random.default_rng(seed), size)
    sequence.first(inputs)
    for kind, chosen in changes:
        inputs = step(inputs, first, kind, chosen)
        sequence.next(inputs)
        np.testing.assert_array_equal(bits(sequence.show()), bits(sequence.fresh(inputs)), kind)


@pytest.mark.parametrize(
    ("precision", "tuning"),
    [
        # The smallest and large ones in one row, with vectors of 8 from half storage: two rows would be built for a minute.
        (
            "half",
            Tuning(
                {24: Winograd(2, 2, 3), 32: Winograd(9, 3, 4), 64: Winograd(1, 1, 1)},
                {n: Direct(1, 1, 2) for n in (24, 32, 64)},
            ),
        ),
        ("float32", Tuning(None, {n: Direct(4, n // 8, 4) for n in (24, 32, 64)})),
    ],
    ids=["winograd", "direct"],
)
@settings(max_examples=4, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(size=sizes(72), changes=CHANGES)
def test_other_tile_sizes(processor, unoptimised, precision, tuning, size, changes):
    """Without the history, whose layers would be a third of the kernels."""
    weights = random_weights(5)
    weights |= {n: np.zeros_like(w) for n, w in weights.items() if n.startswith("lowlevelGated.") and n.endswith(".weight")}
    with trial(tuning):
        sequence = Sequence(processor, size, precision, weights)
        inputs = first = noise(np.random.default_rng(0), size)
        sequence.first(inputs)
        want = network(*(x.astype(np.float64) for x in inputs), sequence.weights)
        assert ratio(f"network.cl.{precision}", sequence.show(), want) <= 1
        for kind, seed in changes:
            inputs = step(inputs, first, kind, seed)
            sequence.next(inputs)
            np.testing.assert_array_equal(bits(sequence.show()), bits(sequence.fresh(inputs)), kind)


def test_work_items_of_two_rows(few_units, unoptimised):
    """Of conv_local.cl, in layers with enough tiles for all units; the other tests' layers have too few."""
    sequence = Sequence(few_units, (72, 40), "half")
    assert {launch.source.options.get("ROWS") for launch in sequence.layers.launches if launch.tiling.images > 1} == {1, 2}
    inputs = first = noise(np.random.default_rng(0), sequence.size)
    sequence.first(inputs)
    for seed, kind in enumerate(("rectangle", "pixel", "nothing", "all", "rectangle", "back")):
        inputs = step(inputs, first, kind, seed)
        sequence.next(inputs)
        np.testing.assert_array_equal(bits(sequence.show()), bits(sequence.fresh(inputs)), kind)


@pytest.mark.parametrize("tall", [False, True])
@pytest.mark.parametrize("precision", QUICK)
@settings(few, max_examples=6)
@given(across=st.integers(0, 15), along=st.integers(0, 799), seed=SEEDS)
def test_far_from_a_change_nothing_is_written(device, precision, tall, across, along, seed):
    """No further than the strips' overlap, and everything that did change is."""
    sequence = far(device, precision, tall)
    inputs = noise(np.random.default_rng(0), sequence.size)
    sequence.first(inputs)
    before = sequence.show()
    sequence.poison()
    changed = [array.copy() for array in inputs]
    changed[0][(along, across) if tall else (across, along)] += np.random.default_rng(seed).random()
    sequence.next(changed)
    written = np.isfinite(sequence.show()).any((1, 2) if tall else (0, 2))
    reach = OVERLAP[precision != "float32-direct"]
    assert written[2 * along]
    places = np.flatnonzero(written) // 2
    assert along - reach <= places.min()
    assert places.max() <= along + reach
    np.testing.assert_array_equal(np.where(np.isnan(sequence.show()), before, sequence.show()), sequence.fresh(changed))


_far = {}


def far(device, precision, tall=False):
    """A frame so long that no change reaches from one end to the other; made once for a precision."""
    if (device, precision, tall) not in _far:
        _far[device, precision, tall] = Sequence(device, (800, 16) if tall else (16, 800), precision)
    return _far[device, precision, tall]


@few
@given(left=st.integers(0, 60), seed=SEEDS)
def test_the_attention_sees_keys_that_changed_alone(device, left, seed):
    """Where its values are the same everywhere nothing else brings the change to it."""
    weights = random_weights(5)
    weights |= {name: np.zeros_like(tensor) for name, tensor in weights.items() if "latentEncoder" in name and "weight" in name}
    sequence = Sequence(device, (64, 512), weights=weights)
    inputs = noise(np.random.default_rng(0), sequence.size)
    sequence.first(inputs)
    changed = [array.copy() for array in inputs]
    changed[1][:, 8 * left : 8 * left + 8] = np.random.default_rng(seed).random((64, 8, 9))
    sequence.next(changed)
    np.testing.assert_array_equal(bits(sequence.show()), bits(sequence.fresh(changed)))


@few
@given(size=sizes(72), seed=SEEDS)
def test_the_input_at_an_eighth_marks_what_changed(device, size, seed):
    random = np.random.default_rng(seed)
    _, gbuffer, mask, _ = noise(random, size)
    other = gbuffer.copy()
    other[random.integers(size[0]) :, random.integers(size[1]) :] += 1
    rows, columns = (-(-n // 8) for n in size)
    held = padded(device, rows, columns, 16, np.dtype(np.float32), changes=True)
    program = build(device, "downsample_8.cl", {"MASK": "float", "MARK": True})
    kernel = cl.Kernel(program, "downsample_8")

    def run(gbuffer):
        buffers = [incoming(device, array) for array in (gbuffer, mask)]
        numbers = (np.int32(n) for n in (*size, rows, columns, held.columns, 0))
        kernel(device.queue, *grid(device, columns, rows), *buffers, held.data, *numbers, held.changes)
        device.queue.finish()
        return contents(device, held)

    before = run(gbuffer)
    cl.enqueue_fill_buffer(device.queue, held.changes, np.zeros(1, np.uint8), 0, held.changes.size)
    after = run(other)
    np.testing.assert_array_equal(raw(device, held.changes).reshape(1, -(-rows // 4), -(-columns // 4)), tiles(before, after))
    assert read(device, held).shape == (rows, columns, 16)
