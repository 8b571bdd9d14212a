"""Computing only what changed: the bits of computing everything, no work where nothing changed, no drift where small steps are let go."""

from functools import cached_property

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from conformance.cases.planes import SEEDS, sizes
from stss_cl.device.buffers import incoming
from stss_cl.network.layers import Layers
from stss_cl.network.strips import OVERLAP
from stss_cl.skip.partial_network import PartialNetwork
from stss_ref.weights import random as random_weights

few = settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
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


@pytest.mark.parametrize("precision", ["float32", "half"])
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


@pytest.mark.parametrize(("precision", "tall"), [("float32-direct", False), ("float32", True), ("half", False)])
@settings(few, max_examples=4)
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


@settings(few, max_examples=5)
@given(left=st.integers(0, 15), seed=SEEDS)
def test_the_attention_sees_keys_that_changed_alone(device, left, seed):
    """Where its values are the same everywhere nothing else brings the change to it."""
    weights = random_weights(5)
    weights |= {name: np.zeros_like(tensor) for name, tensor in weights.items() if "latentEncoder" in name and "weight" in name}
    sequence = Sequence(device, (40, 128), weights=weights)
    inputs = noise(np.random.default_rng(0), sequence.size)
    sequence.first(inputs)
    changed = [array.copy() for array in inputs]
    changed[1][:, 8 * left : 8 * left + 8] = np.random.default_rng(seed).random((40, 8, 9))
    sequence.next(changed)
    np.testing.assert_array_equal(bits(sequence.show()), bits(sequence.fresh(changed)))
