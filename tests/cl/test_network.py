"""The network on OpenCL: layers and stages against the reference, and properties that need no reference."""

from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from conformance.cases.planes import SEEDS, sizes
from conformance.tolerance import ratio, worst
from stss_cl.device.buffers import constant, pad, read, write
from stss_cl.device.program import FLUSH, source
from stss_cl.device.tuning import BUILT_IN, Winograd, built_in_rows, trial
from stss_cl.liveness import drop_tiny, is_tiny
from stss_cl.network import conv as conv_module
from stss_cl.network import layers as layers_module
from stss_cl.network.conv import ConvSpec, conv
from stss_cl.network.layers import Layers
from stss_cl.network.network import Network
from stss_cl.network.pack_weights import EVERY_SECOND, POINTS, pack, winograd_matrix
from stss_lab.tune.tile_timing import INTEL
from stss_ref import conv as reference
from stss_ref.network import network
from stss_ref.weights import LAYERS, SOURCES, astype
from stss_ref.weights import random as random_weights
from tests.cl.conftest import ALL_LAYERS, OFTEN
from tests.cl.films import network_inputs
from tests.sum_bound import sum_bound
from tests.tiers import thorough

_rows = built_in_rows(BUILT_IN)
VECTORS = {8: _rows.classes["cpu"], 16: _rows.targets["rocketlake"]}
"""Rows of sizes by the lanes of their vectors."""
SMALL = replace(
    VECTORS[16],
    winograd={24: Winograd(2, 2, 2, vector=16), 32: Winograd(2, 1, 1, vector=16), 64: Winograd(4, 2, 2, vector=16)},
)
"""Other sizes with vectors of 16."""

few = settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])


def polynomial(roots):
    """Coefficients of the product of (x - root), lowest power first."""
    return np.poly(roots)[::-1]


def transforms(side, stride=1):
    """A^T and B^T of F(side x side, 3x3) from the points alone, independent of the kernel's constants.

    At stride 2: Karatsuba's three products for the outer taps, then two for the middle one.
    """
    if stride == 2:
        a = np.array([[1, 1, 0, 1, 0], [0, 1, -1, 0, 1]])
        return a, np.array([[1, 0, -1, 0, 0], [0, 0, 1, 0, 0], [0, 0, 1, 0, -1], [0, 1, 0, 0, 0], [0, 0, 0, 1, 0]])
    points = POINTS[side]
    a = np.array([[x**i for x in points] + [float(i == side - 1)] for i in range(side)])
    rows = [np.append(polynomial([p for p in points if p != x]), 0) for x in points]
    return a, np.array([*rows, polynomial(points)])


def tensors(random, name, inputs, outputs, gated):
    """A layer's tensors under the checkpoint's names, scaled so that activations stay of order 1."""
    branches = {".conv_feature": outputs, ".conv_mask.0": 1} if gated else {"": outputs}
    arrays = {}
    for branch, channels in branches.items():
        arrays[f"{name}{branch}.weight"] = (random.normal(size=(channels, inputs, 3, 3)) / np.sqrt(9 * inputs)).astype(np.float32)
        arrays[f"{name}{branch}.bias"] = random.normal(size=channels).astype(np.float32)
    return arrays


def winograd_scale(x, weight, side, stride=1):
    """What one rounding anywhere in F(side x side, 3x3) can move the result by: the algorithm on absolute values."""
    a, b = (np.abs(m) for m in transforms(side, stride))
    g = np.abs(winograd_matrix(side) if stride == 1 else EVERY_SECOND)
    u = np.einsum("ku,ocuv,lv->klco", g, np.abs(weight.astype(np.float64)), g)
    height, width, channels = x.shape
    rows, columns = (-(-length // (stride * side)) for length in (height, width))
    tiled = np.zeros((stride * side * rows + 2, stride * side * columns + 2, channels))
    tiled[1 : height + 1, 1 : width + 1] = np.abs(x)
    scale = np.zeros((side * rows, side * columns, weight.shape[0]))
    for i in range(0, scale.shape[0], side):
        for j in range(0, scale.shape[1], side):
            y, z = stride * i, stride * j
            v = np.einsum("ki,ijc,lj->klc", b, tiled[y : y + b.shape[1], z : z + b.shape[1]], b)
            scale[i : i + side, j : j + side] = np.einsum("yk,klo,xl->yxo", a, np.einsum("klc,klco->klo", v, u), a)
    return scale[: height // stride, : width // stride]


def bounds(x, weights, stride, side, *, gated):
    """The layer in float64, and how far sums in float32 may be from it: of the plain convolution, or of Winograd's for ``side``."""
    exact, wide = x.astype(np.float64), {name: array.astype(np.float64) for name, array in weights.items()}
    absolute = {name: np.abs(array) for name, array in wide.items()}
    feature, gate = ("layer.conv_feature", "layer.conv_mask.0") if gated else ("layer", None)

    def allowed(branch):
        if side:
            scale = winograd_scale(x, weights[f"{branch}.weight"], side, stride) + absolute[f"{branch}.bias"]
            return sum_bound(x.shape[-1] + 28, scale, np.float32)
        return sum_bound(9 * x.shape[-1] + 2, reference.conv_named(exact, absolute, branch, stride), np.float32)

    if not gated:
        return reference.conv_named(exact, wide, "layer", stride), allowed(feature)
    # The gate's error counts a quarter (the sigmoid's steepest slope) times the feature; the sigmoid's own 8 roundings too.
    magnitude = reference.conv_named(exact, absolute, feature, stride)
    return reference.gated(exact, wide, "layer", stride), allowed(feature) + magnitude * (allowed(gate) / 4 + 8 * 2.0**-24)


@pytest.mark.parametrize(
    ("size", "channels", "gated", "relu", "stride", "vector"),
    [
        thorough((5, 7), (24, 24, 24), False, True, 1, 8),
        thorough((5, 43), (24, 24, 24), False, False, 1, 16),
        thorough((5, 43), (24, 0, 24), True, True, 1, 16),
        thorough((5, 43), (24, 24, 24), False, True, 1, "small"),
        ((13, 21), (32, 0, 32), True, False, 1, 8),
        thorough((9, 10), (96, 0, 32), False, True, 1, 16),
        thorough((6, 11), (32, 16, 64), True, True, 1, 8),
        thorough((7, 17), (32, 96, 64), False, True, 1, 16),
        ((5, 9), (4, 0, 24), False, True, 2, 8),
        thorough((7, 11), (24, 0, 24), True, True, 2, 16),
        thorough((6, 7), (24, 0, 32), False, True, 2, 8),
        thorough((9, 5), (32, 0, 32), True, True, 2, 16),
    ],
    ids=str,
)
def test_all_convolutions_are_the_references(processor, size, channels, gated, relu, stride, vector):
    """Direct and Winograd, tiles and vectors of either size, one and two inputs, gated or not: within the bound of their arithmetic."""
    first, second, outputs = channels
    random = np.random.default_rng(0)
    x = random.random((stride * size[0], stride * size[1], first + second), dtype=np.float32)
    weights = tensors(random, "layer", first + second, outputs, gated)
    packed = pack(weights, "layer", tuple((n, n) for n in (first, second) if n))
    inputs = [pad(processor, *x.shape[:2], n, np.dtype(np.float32)) for n in (first, second) if n]
    out = pad(processor, *size, outputs, np.dtype(np.float32))
    for buffer, channel in zip(inputs, (0, first), strict=False):
        write(processor, buffer, x[..., channel : channel + buffer.channels])
    for side in (0, 2, 4) if stride == 1 else (0, 2):
        with trial(SMALL if vector == "small" else VECTORS[vector]):
            launch = conv(processor, ConvSpec("test", "layer", packed, stride, relu, side), inputs[0], (*inputs, None)[1], out)
        launch.enqueue(processor.queue)
        by_winograd = side if launch.source.file == "winograd.cl" else 0
        want, allowed = bounds(x, weights, stride, by_winograd, gated=gated)
        want = reference.relu(want) if relu else want
        assert worst(np.abs(read(processor, out) - want), allowed) <= 1, f"tiles of {side}" if side else "direct"


@pytest.mark.thorough
@few
@given(at=st.tuples(st.integers(0, 19), st.integers(0, 23)), gated=st.booleans(), stride=st.sampled_from([1, 2]), seed=SEEDS)
def test_rounding_stays_within_a_tile(processor, at, gated, stride, seed):
    """One changed input changes bits no farther away than a tile's side, or, without tiles and at stride 2, what reads it: decision 11."""
    random = np.random.default_rng(seed)
    packed = pack(tensors(random, "layer", 24, 24, gated), "layer", ((24, 24),))
    x = random.random((20, 24, 24), dtype=np.float32)
    source, out = (pad(processor, 20 // n, 24 // n, 24, np.dtype(np.float32)) for n in (1, stride))
    far = np.abs(stride * np.stack(np.mgrid[: 20 // stride, : 24 // stride], -1) - at).max(axis=-1)
    for side in (0, 2, 4):
        images = []
        for value in (x[at], 1 - x[at]):
            x[at] = value
            write(processor, source, x)
            spec = ConvSpec("test", "layer", packed, stride, relu=False, side=side)
            conv(processor, spec, source, None, out).enqueue(processor.queue)
            images.append(read(processor, out))
        differs = (images[0] != images[1]).any(axis=-1)
        assert differs[far <= 1].all()
        assert not differs[far > (max(side, 1) if stride == 1 else 1)].any(), side


@ALL_LAYERS
def test_small_tiles_at_an_eighth(device):
    """Of the whole network's layers; those of the overlap of strips count on it."""
    layers = Layers(device, random_weights(0), (32, 48), "float32", keep=True)
    fast = [x for x in layers.launches if x.source.options.get("STRIDE") == 1 and "SIDE" in x.source.options]
    sides = {(x.source.options["SIDE"], x.tiling.rows) for x in fast}
    assert not fast or sides == {(4, 32 // 4), (4, 16 // 4), (4, 8 // 4), (2, 4 // 2)}


@pytest.fixture(scope="module", params=OFTEN)
def net(request, device):
    if request.param == "bfloat16" and not device.is_cpu:
        pytest.skip("the same kernels on either class")
    return Network(random_weights(5), device, request.param)


@ALL_LAYERS
@few
@example(size=(1, 1), seed=0, share=0.7)
@example(size=(8, 16), seed=0, share=0.0)
@given(size=sizes(40), seed=SEEDS, share=st.sampled_from([0.0, 0.5, 1.0]))
def test_the_image_is_the_references(net, size, seed, share):
    inputs = network_inputs(size, seed, share)
    image = net(*inputs)
    assert image.dtype == np.float32
    want = network(*(x.astype(np.float64) for x in inputs), random_weights(5))
    assert ratio(f"network.cl.{net.precision}", image, want) <= 1


@pytest.mark.thorough
def test_the_image_with_vectors_of_16(processor, unoptimised):
    """From half storage: the stores and the image's own layer, too, know them. Those of 8: test_stream.py, other tile sizes."""
    if processor.name.startswith(INTEL):
        pytest.skip("its compiler takes minutes for one of these kernels")
    inputs = network_inputs((29, 43), 3)
    with trial(VECTORS[16]):
        image = Network(random_weights(5), processor, "half")(*inputs)
    want = network(*(x.astype(np.float64) for x in inputs), random_weights(5))
    assert ratio("network.cl.half", image, want) <= 1


@ALL_LAYERS
@pytest.mark.parametrize("name", ["arena_small", "lewis_wide"])
@pytest.mark.parametrize("precision", OFTEN)
def test_the_image_is_the_authors(reference_data, device, name, precision):
    if precision == "bfloat16" and not device.is_cpu:
        pytest.skip("the same kernels on either class")
    from safetensors.numpy import load_file

    from stss.weights.checkpoint import read_checkpoint

    data = load_file(reference_data / "network" / f"{name}.safetensors")
    inputs = [np.ascontiguousarray(np.moveaxis(data[f"input.{key}"], -3, -1)) for key in ("color", "gbuffer", "mask", "history")]
    inputs[2] = inputs[2][..., 0]
    weights = read_checkpoint(reference_data / "checkpoints" / f"{name.split('_')[0]}.pkl")
    want = np.moveaxis(data["output.float64"], 0, -1)
    assert ratio(f"network.cl.{precision}", Network(weights, device, precision)(*inputs), want) <= 1


def without(weights, *layers):
    """The same with kernels of 0 in these layers."""
    return weights | {n: w * 0 for n, w in weights.items() if n.startswith(layers) and w.ndim == 4}


@ALL_LAYERS
@pytest.mark.parametrize("keep", [False, True])
def test_layers_that_nobody_reads_are_left_out(device, keep):
    """And what no frame changes is computed once."""
    weights = random_weights(3)
    # On GPUs the three images of a layer go in one launch.
    history = 27 if device.is_cpu else 9
    for tensors_of, left_out, once in (
        (weights, 0, 0),
        (without(weights, "lowlevelGated"), history + 1, 1),
        (without(weights, "lowlevelGated", "down3.conv2"), history + 1 + 3, 2),
    ):
        layers = Layers(device, tensors_of, (16, 24), "float32", keep=keep)
        assert len(layers.launches) == len(Layers(device, weights, (16, 24), "float32", keep=keep).launches) - left_out
        assert len(layers.once) == once
        assert layers.reads_history == (tensors_of is weights)


def without_units(weights, seed):
    """The same with a fifth of all eights of units 0, and a fifth of them read by nobody."""
    random, tensors, fates = np.random.default_rng(seed), dict(weights), {}
    for layer in LAYERS[:-1]:
        fates[layer.name] = fate = random.integers(5, size=8).repeat(8)[: layer.outputs]
        fates |= {name: np.zeros(SOURCES[name]) for name in layer.reads if name in SOURCES}
        fates["reshaded"] = fates.get("latentEncoder.4")
        columns = np.concatenate([np.tile(fates[name], 3 if name == "convHis3.4" else 1) for name in layer.reads])
        for name, shape in layer.tensors():
            tensor = np.abs(tensors[name]) if len(shape) == 1 else tensors[name].copy()
            if len(shape) == 4:
                tensor[:, columns == 1] = 0
            if shape[0] > 1:
                tensor[fate == 0] *= -1.0 if tensor.ndim == 1 and layer.relu else 0.0
            tensors[name] = tensor
    return weights | tensors


@pytest.mark.thorough
@example({"convHis1.0"}, 3, False, "float32", 16)
@given(
    st.sets(st.sampled_from([layer.name for layer in LAYERS]), max_size=4), st.none(), st.booleans(), st.just("float32"), st.just(8)
)  # fmt: skip
@settings(max_examples=4, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_left_out_changes_no_bit(processor, unoptimised, names, units, keep, precision, vector):
    """Any layers whose kernels are 0, what only they read, and groups of units: one draw, which compiles kernels of its own."""
    weights, arrays = without(random_weights(3), *names), network_inputs((16, 24), 3)
    if units is not None:
        weights = without_units(weights, units)
    inputs = dict(zip(("color", "gbuffer", "mask", "history"), arrays, strict=True))
    with trial(VECTORS[vector]):
        images = [
            Layers(processor, weights, (16, 24), precision, keep=keep, every=every).run_stage("network", inputs)["image"]
            for every in (False, True)
        ]
    np.testing.assert_array_equal(*images)


@ALL_LAYERS
def test_weights_that_read_no_history_have_the_references_image(device):
    weights = without(random_weights(3), "lowlevelGated")
    inputs, own = network_inputs((16, 24), 3), Network(weights, device)
    image = own(*inputs)
    assert ratio("network.cl", image, network(*(x.astype(np.float64) for x in inputs), astype(weights, np.float64))) <= 1
    inputs[3][:] = np.nan  # nobody looks
    np.testing.assert_array_equal(own(*inputs), image)


@ALL_LAYERS
def test_the_same_bits_every_time(net):
    """Repeated, after another size, and from arrays that lie elsewhere."""
    inputs = network_inputs((24, 33), 1)
    first = net(*inputs)
    net(*network_inputs((8, 8), 2))
    np.testing.assert_array_equal(net(*(x.copy() for x in inputs)), first)
    np.testing.assert_array_equal(net(*inputs), first)


@ALL_LAYERS
def test_the_memory_of_a_dropped_image_serves_the_next(net, device):
    import pyopencl.array as cla

    inputs, others = [cla.to_device(device.queue, x) for x in network_inputs((9, 10), 4)], device.pool.active_blocks
    first, second = net(*inputs), net(*inputs)
    assert device.pool.active_blocks == others + 2, "an image that is held must keep its memory"
    managed = device.pool.managed_bytes
    del first, second
    for _ in range(4):
        net(*inputs)
    assert (device.pool.active_blocks, device.pool.managed_bytes) == (others, managed)


def with_tiny(weights):
    """The same with numbers below ``TINY`` at some places, subnormal ones too, and windows whose taps cancel in Winograd's transforms."""
    random, tensors = np.random.default_rng(0), {}
    for name, tensor in weights.items():
        tensors[name] = np.where(random.random(tensor.shape) < 0.3, tensor * np.float32(1e-37), tensor)
        if tensor.shape[-1:] == (3,):
            tensors[name][::5, ::7] = 0
            tensors[name][::5, ::7, 0] = np.float32(2.0**-90) * np.array(
                [-np.nextafter(np.float32(POINTS[4][0] ** 2), 1), 0, 1], np.float32
            )
    return weights | tensors


@pytest.mark.parametrize("precision", ["float32", thorough("float32-direct")])
def test_nothing_tiny_is_packed(processor, monkeypatch, request, precision):
    """Of weights that have it: 0 takes its place, also behind transforms, and the image keeps the bits of those without."""
    if precision == "float32-direct":  # no other test of every commit has its kernels
        request.getfixturevalue("unoptimised")
    packed = []
    for module in (conv_module, layers_module):
        monkeypatch.setattr(module, "constant", lambda device, array: packed.append(array) or constant(device, array))
    weights = with_tiny(random_weights(3))
    assert sum(is_tiny(tensor).sum() for tensor in weights.values()) > 1000
    inputs = network_inputs((16, 24), 3)
    images = [Network(these, processor, precision)(*inputs) for these in (weights, drop_tiny(weights))]
    assert len(packed) > 60
    assert not any(is_tiny(array).any() for array in packed)
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("side", [0, 2, 4])
def test_what_is_subnormal_is_0(processor, side):
    """Products too: the time of the network does not depend on the data. PoCL alone says by which option."""
    packed = pack(
        {"layer.weight": np.full((24, 24, 3, 3), 2.0**-60, np.float32), "layer.bias": np.zeros(24)}, "layer", ((24, 24),)
    )
    x, out = (pad(processor, 8, 8, 24, np.dtype(np.float32)) for _ in range(2))
    for value, is_zero in ((2.0**-70, True), (2.0**-50, False)):
        write(processor, x, np.where(np.arange(24) == 5, np.float32(value), np.zeros((8, 8, 24), np.float32)))
        conv(processor, ConvSpec("test", "layer", packed, side=side), x, None, out).enqueue(processor.queue)
        assert (read(processor, out) == 0).all() == is_zero


@pytest.mark.filterwarnings("ignore::pyopencl.CompilerWarning")  # NVIDIA's compiler says that it built it
def test_every_half_is_widened_and_comes_back(device):
    """Subnormal ones too, though floats that are subnormal are flushed."""
    text = (
        source("common.clh")
        + "kernel void both(global const ushort *from, global float *to, global ushort *back, global float *each)\n{\n"
    )
    text += "const int i = get_global_id(0);\nSTORE8(LOAD8(from, i), i, back);\nvstore8(LOAD8(from, i), i, to);\n"
    text += "for (int j = 8 * i; j < 8 * i + 8; ++j) each[j] = LOAD(from, j);\n}"
    program = cl.Program(device.context, text).build(f"-cl-std=CL1.2 -D STORED=HALF {FLUSH}")
    half = np.arange(65536, dtype=np.uint16)
    half = half[np.isfinite(half.view(np.float16))]
    halves, wide, back, each = (cl.Buffer(device.context, cl.mem_flags.READ_WRITE, half.size * n) for n in (2, 4, 2, 4))
    cl.enqueue_copy(device.queue, halves, half)
    cl.Kernel(program, "both")(device.queue, (half.size // 8,), None, halves, wide, back, each)
    got, again = np.empty(half.size, np.float32), np.empty_like(half)
    cl.enqueue_copy(device.queue, again, back)
    for target in (wide, each):
        cl.enqueue_copy(device.queue, got, target)
        np.testing.assert_array_equal(got.view(np.uint32), half.view(np.float16).astype(np.float32).view(np.uint32))
    np.testing.assert_array_equal(again, half)
