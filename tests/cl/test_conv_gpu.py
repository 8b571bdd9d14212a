"""The convolutions for GPUs, on any device, against the reference; those for processors, too, over the tiles of a list."""

from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest

from conformance.tolerance import worst
from stss_cl.device import matrix_units
from stss_cl.device.buffers import constant, map_bytes, pad, read, write
from stss_cl.device.discovery import open_device
from stss_cl.device.parts import make_zeros
from stss_cl.device.tuning import Direct, Local, Winograd, built_in, trial
from stss_cl.network import conv_gpu
from stss_cl.network import layer as layer_module
from stss_cl.network.conv import ConvSpec, conv
from stss_cl.network.pack_weights import pack
from stss_cl.network.tiles import TileList
from stss_ground.errors import DeviceError
from tests.cl.conftest import anew
from tests.cl.test_network import bounds, tensors
from tests.tiers import every, thorough

pytestmark = pytest.mark.usefixtures("unoptimised")
MATRIX = Local(2, matrix_units=True)
FLOAT, HALF = np.dtype(np.float32), np.dtype(np.float16)
LAYERS = [
    # size, channels of both inputs, outputs, gated, stride
    ((21, 37), 24, 0, 24, True, 1),
    ((17, 65), 24, 24, 24, False, 1),
    ((9, 35), 32, 96, 64, False, 1),
    ((5, 7), 16, 0, 48, False, 1),
    ((11, 35), 24, 32, 32, False, 1),
    ((5, 70), 96, 0, 32, True, 1),
    ((20, 36), 24, 0, 24, True, 2),
    ((12, 33), 32, 0, 16, False, 2),
    ((11, 35), 4, 0, 24, False, 2),
]


@pytest.fixture(scope="module")
def device():
    return open_device(device_class="gpu")


class Case:
    """A layer with random inputs and weights that half holds exactly."""

    def __init__(self, device, layer, dtype, seed=0):
        self.size, self.a, self.b, self.outputs, self.gated, self.stride = layer
        self.device, random = device, np.random.default_rng(seed)
        inputs = self.size[0] * self.stride, self.size[1] * self.stride
        self.x = random.random((*inputs, self.a + self.b)).astype(HALF)
        arrays = tensors(random, "layer", self.a + self.b, self.outputs, self.gated)
        self.weights = {name: array.astype(HALF).astype(FLOAT) for name, array in arrays.items()}
        self.packed = pack(self.weights, "layer", tuple((n, n) for n in (self.a, self.b) if n))
        self.inputs = [pad(device, *inputs, n, dtype) for n in (self.a, self.b) if n]
        for buffer, first in zip(self.inputs, (0, self.a), strict=False):
            write(device, buffer, self.x[..., first : first + buffer.channels])
        self.out = replace(pad(device, *self.size, self.outputs, dtype), changes=make_zeros(device, map_bytes(*self.size)))

    def layer(self, local, side=4):
        return self.by(replace(built_in(self.device), winograd=None, local=local), side)

    def by(self, row, side=4):
        with trial(row):
            spec = ConvSpec("test", "layer", self.packed, self.stride, side=side)
            return conv(self.device, spec, self.inputs[0], (*self.inputs, None)[1], self.out)

    def run(self, layer, before=np.nan):
        """What the layer leaves of what was there before; nothing is written beyond the image."""
        write(self.device, self.out, np.broadcast_to(np.float32(before), (*self.size, self.outputs)))
        layer.enqueue(self.device.queue)
        host = np.empty((self.out.rows, self.out.columns, self.outputs), self.out.dtype)
        cl.enqueue_copy(self.device.queue, host, self.out.data)
        host[self.out.inside] = 0
        assert not host.any()
        return read(self.device, self.out)

    def is_right(self, layer, dtype):
        """Within what sums in float32, and storing in ``dtype``, may lose."""
        want, allowed = bounds(self.x, self.weights, self.stride, 0, gated=self.gated)
        want = np.maximum(want, 0)
        rounding = 0 if dtype == FLOAT else 2.0**-11 * np.abs(want) + 2.0**-24
        return worst(np.abs(self.run(layer) - want), allowed + rounding) <= 1


@pytest.mark.parametrize(("layer", "dtype", "rows"), [*zip(LAYERS, 5 * (FLOAT, HALF), 3 * (1, 1, 2, 2), strict=False)], ids=str)
def test_local(device, layer, dtype, rows):
    case = Case(device, layer, dtype)
    launch = case.layer(Local(rows))
    assert launch.source.file == "conv_local.cl"
    assert case.is_right(launch, dtype)


@pytest.mark.parametrize("layer", every(4, LAYERS), ids=str)
def test_matrix_units(device, layer):
    case = Case(device, layer, HALF)
    launch = case.layer(MATRIX)
    assert launch.source.file == "conv_mma.cl"
    assert case.is_right(launch, HALF)


@pytest.mark.parametrize(("layer", "eights", "tiles"), [(LAYERS[0], 3, 3), (LAYERS[5], 4, 1)], ids=str)
def test_weights_in_local_memory(device, layer, eights, tiles, monkeypatch):
    """Copied once for all tiles of a group, or for each tile part by part where they do not fit at once."""
    monkeypatch.setattr(conv_gpu, "GROUPS", 1)
    case = Case(device, layer, HALF)
    launch = case.layer(MATRIX)
    assert launch.source.options["EIGHTS_AT_ONCE"] == eights
    assert launch.tiling.most * matrix_units.LANES == tiles * launch.size[0]
    assert case.is_right(launch, HALF)


def test_which_kernel(device):
    """Float32 needs float32's products; the plain kernel on request."""
    assert Case(device, LAYERS[0], FLOAT).layer(MATRIX).source.file == "conv_local.cl"
    assert Case(device, LAYERS[0], HALF).layer(MATRIX, side=0).source.file == "conv.cl"
    assert Case(device, LAYERS[0], HALF).layer(None).source.file == "conv.cl"


def not_built(*_):
    raise DeviceError("unknown instruction")


def swapped(*places):
    """Weights of which two outputs, or two channels, changed places."""
    right = matrix_units.arrange
    return lambda weight: right(weight[places])


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("constant", lambda device, array: constant(device, array * 2)),
        ("program_for", not_built),
        ("arrange", swapped(..., [1, 0])),
        ("arrange", swapped(..., [1, 0, *range(2, 16)], slice(None), slice(None))),
    ],
)
def test_what_is_not_proved_is_not_used(device, monkeypatch, name, fault):
    assert matrix_units.prove(device)
    device = anew(device)
    monkeypatch.setattr(matrix_units, name, fault)
    assert not matrix_units.prove(device)
    assert Case(device, LAYERS[0], HALF).layer(MATRIX).source.file == "conv_local.cl"


ROWS = {
    "local": {"winograd": None, "local": Local(1)},
    "local, two rows": {"winograd": None, "local": Local(2)},
    "matrix units": {"winograd": None, "local": MATRIX},
    "plain": {"winograd": None, "local": None, "direct": {24: Direct(4, 3, 4)}},
    "plain, few at once": {"winograd": None, "local": None, "direct": {24: Direct(1, 1, 2)}},
    "Winograd": {"winograd": {24: Winograd(9, 3, 3)}},
    "Winograd, few at once": {"winograd": {24: Winograd(1, 1, 1)}},
    "Winograd, vectors of 16": {"winograd": {24: Winograd(2, 2, 2, vector=16)}},
}


@pytest.mark.parametrize(("name", "dtype"), [*((name, HALF) for name in ROWS), ("Winograd, vectors of 16", FLOAT)], ids=str)
@pytest.mark.parametrize(("layer", "by_option"), [(LAYERS[0], False), thorough(LAYERS[6], True)], ids=str)
def test_tiles_of_a_list(device, processor, monkeypatch, layer, by_option, name, dtype):
    """Only the listed tiles are written, whatever the number of work-groups; a pixel is marked if its bits now differ.

    That it marks, a kernel is told by a map, or, as on GPUs, when it is built.
    """
    if by_option:
        monkeypatch.setattr(layer_module, "marking", lambda _, marks: {"MARK": int(marks)})
    device = device if ROWS[name].get("local") else processor
    case = Case(device, layer, dtype)
    launch = case.by(replace(built_in(device), **ROWS[name]))
    whole = case.run(launch)
    tiling = launch.tiling
    tall, wide = (pixels // case.stride for pixels in tiling.step)
    tiles = np.array([(y, x) for y in range(tiling.rows) for x in range(tiling.columns)])[1::2]
    numbers = constant(device, (tiles[:, 0] << 16 | tiles[:, 1]).astype(np.uint32))
    tile_list = TileList(numbers, constant(device, np.array([len(tiles)], np.int32)))
    some = replace(launch.over(device, tile_list), size=(launch.group[0], *launch.size[1:]))
    inside = np.zeros(case.size, bool)
    for y, x in tiles:
        inside[tall * y : tall * (y + 1), wide * x : wide * (x + 1)] = True
    for channel in (3, 9, 17):  # in which alone bits differ
        before, marks = whole.copy(), np.zeros((case.out.rows - 2, case.out.columns - 2), np.bool_)
        before[..., channel] = np.nan
        cl.enqueue_copy(device.queue, case.out.changes, marks)
        got = case.run(some, before)
        np.testing.assert_array_equal(got, np.where(inside[..., None], whole, before))
        cl.enqueue_copy(device.queue, marks, case.out.changes)
        np.testing.assert_array_equal(marks[: case.size[0], : case.size[1]], inside)


@pytest.mark.parametrize("local", [Local(1), MATRIX], ids=str)
def test_three_images_in_one_launch(device, local):
    """Into channels: the same bits as one after the other."""
    case, outputs = Case(device, ((5, 19), 24, 0, 24, True, 1), HALF), []
    inputs = pad(device, *case.size, 24, HALF, images=3)
    write(device, inputs, np.random.default_rng(1).random((3, *case.size, 24)))
    for images in ((None,), range(3)):
        out = pad(device, *case.size, 72, HALF)
        with trial(replace(built_in(device), winograd=None, local=local)):
            for image in images:
                first = 24 * (image or 0)
                spec = ConvSpec("test", "layer", case.packed)
                conv(device, spec, inputs, None, out, image=image, out_first=first).enqueue(device.queue)
        outputs.append(read(device, out))
    assert outputs[0].any()
    np.testing.assert_array_equal(*outputs)
