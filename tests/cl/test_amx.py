"""Convolutions on a processor's matrix units, emulated here: the bits that the units must give, and the devices that are trusted with
them."""

from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

from stss.devices import selection
from stss.frames.backends import open_backend
from stss.frames.compute_options import ComputeOptions
from stss_cl.device import amx
from stss_cl.device.buffers import BFLOAT16, from_bfloat16, pad, read, to_bfloat16, write
from stss_cl.device.discovery import Properties
from stss_cl.network import layers
from stss_cl.network.conv import ConvSpec, conv
from stss_cl.network.network import Network
from stss_cl.network.pack_weights import amx_bias, amx_tiles, pack
from stss_cl.network.plan import plan_network
from stss_ground.errors import DeviceError
from stss_ref.weights import random as random_weights
from stss_ref.weights import zeros
from tests.cl.conftest import anew
from tests.cl.films import network_inputs
from tests.cl.test_network import tensors

LAYERS = [
    # size, channels of both inputs, outputs, gated, stride
    ((9, 37), 24, 0, 24, True, 1),
    ((5, 70), 32, 96, 64, False, 1),
    ((7, 34), 32, 0, 32, True, 2),
    ((5, 40), 4, 0, 24, False, 2),
]


def test_bfloat16_is_the_nearest_of_both_neighbours():
    random = np.random.default_rng(0)
    x = np.append(
        (random.normal(size=1000) * 10.0 ** random.integers(-30, 30, 1000)).astype(np.float32), [0, -0.0, 1e-40, -1e-40]
    )
    got, spacing = from_bfloat16(to_bfloat16(x)), 2.0 ** (np.floor(np.log2(np.maximum(np.abs(x), 2.0**-126))) - 7)
    assert (np.abs(got.astype(np.float64) - x) <= spacing / 2)[:-4].all()
    assert (got[-4:] == 0).all()
    ties = from_bfloat16(to_bfloat16(np.array([1 + 2.0**-8, 1 + 3 * 2.0**-8], np.float32)))
    np.testing.assert_array_equal(ties, [1, 1 + 2.0**-6])  # to even


def sums_of(inputs, packed, size, stride):
    """Each output's sum and the gate's behind them, (H, W, outputs), with the roundings of the units: from the buffers as they lie."""
    tiles, bias = amx_tiles(packed, inputs[0].channels), amx_bias(packed)
    y, x = (np.indices(size) * stride).reshape(2, -1)
    sums = np.tile(bias, (y.size, 1))
    step = 0
    for buffer in inputs:
        values = np.zeros((buffer.data.size // 2,), np.uint16)
        cl.enqueue_copy(buffer.queue, values, buffer.data)
        for tap in range(3):
            for k in range(-(-3 * buffer.channels // 32)):
                first = ((y + tap) * buffer.columns + x) * buffer.channels + (24 if buffer.channels == 24 else 32) * k
                a = values[first[:, None] + np.arange(32)]
                for part in range(len(bias) // 16):
                    place = slice(16 * part, 16 * part + 16)
                    sums[:, place] = amx.multiply(sums[:, place], a, tiles[step, part])
                step += 1
    return sums.reshape(*size, -1)


@pytest.fixture(params=["emulated", "units"])
def units(request, processor, monkeypatch):
    """Products are emulated, or computed by matrix units where there are some."""
    if request.param == "units" and amx.missing(processor):
        pytest.skip(amx.missing(processor))
    monkeypatch.setattr(amx, "are_used", lambda _: request.param == "units")


@pytest.mark.parametrize("layer", LAYERS, ids=str)
def test_a_layer_has_the_bits_of_the_units(processor, unoptimised, units, layer):
    size, a, b, outputs, gated, stride = layer
    random = np.random.default_rng(0)
    packed = pack(tensors(random, "layer", a + b, outputs, gated), "layer", tuple((n, n) for n in (a, b) if n))
    inputs = [pad(processor, size[0] * stride, size[1] * stride, n, BFLOAT16) for n in (a, b) if n]
    for buffer in inputs:
        write(processor, buffer, random.normal(size=(buffer.height, buffer.width, buffer.channels)))
    out = pad(processor, *size, outputs, BFLOAT16)
    launch = conv(processor, ConvSpec("test", "layer", packed, stride), inputs[0], (*inputs, None)[1], out)
    assert launch.source.file == "conv_amx.cl"
    launch.enqueue(processor.queue)
    buffers = [SimpleNamespace(data=h.data, channels=h.channels, columns=h.columns, queue=processor.queue) for h in inputs]
    sums = sums_of(buffers, packed, size, stride)
    want, got = np.maximum(sums[..., :outputs], 0), read(processor, out)
    if not gated:
        np.testing.assert_array_equal(got, from_bfloat16(to_bfloat16(want)))
        return
    want = want / (1 + np.exp(-sums[..., outputs : outputs + 1].astype(np.float64)))
    # One rounding to bfloat16; those of the gate are 2**-16 of it.
    assert (np.abs(got - want) <= (2.0**-8 + 2.0**-20) * want).all()


def test_the_emulated_product_is_right(device):
    assert amx.product_is_right(device, emulate=True)


@pytest.mark.parametrize(("scale", "others"), [(-62, -64), (-110, -12), (60, 64)])
def test_products_beyond_floats_range_are_added_exactly(processor, units, scale, others):
    """Many are subnormal, or larger than any float, and their sums are not; subnormal sums and biases are 0."""
    random, emulate = np.random.default_rng(1), not amx.are_used(processor)
    for _ in range(8):
        powers = [random.integers(power - 3, power + 3, size) for power, size in ((scale, (16, 32)), (others, (16, 16, 2)))]
        a, b = (to_bfloat16(random.normal(size=power.shape) * 2.0**power) for power in powers)
        bias = (random.normal(size=16) * 2.0 ** (scale + others)).astype(np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            want = amx.multiply(np.broadcast_to(bias, (16, 16)), a, b)
        np.testing.assert_array_equal(amx.product(processor, bias, a, b, emulate=emulate), want)


def test_a_wrong_product_is_seen(device, monkeypatch):
    right = amx.multiply
    monkeypatch.setattr(amx, "multiply", lambda sums, a, b: right(sums, a, b[:, ::-1]))
    assert not amx.product_is_right(device, emulate=True)


@pytest.mark.parametrize("fault", ["wrong", "not built"])
def test_what_is_not_proved_is_not_used(processor, monkeypatch, fault):
    def tried(device, *, emulate):
        assert not emulate
        if fault == "not built":
            raise DeviceError("unknown instruction")
        return fault != "wrong"

    monkeypatch.setattr(amx, "missing", lambda _: "")
    monkeypatch.setattr(amx, "product_is_right", tried)
    assert not amx.are_used(anew(processor))
    monkeypatch.setattr(amx, "product_is_right", lambda device, *, emulate: True)
    assert amx.are_used(anew(processor))


def test_what_is_missing_is_said(gpu, monkeypatch):
    platform = SimpleNamespace(name="Portable Computing Language")
    pocl = Properties(SimpleNamespace(platform=platform, name="cpu", type=cl.device_type.CPU))
    monkeypatch.setattr(amx.platform, "machine", lambda: "x86_64")
    assert amx.missing(gpu) == "no processor"
    both = "amx_bf16 amx_tile avx512_bf16 avx512vl"
    for flags, allowed, words in (("avx2 amx_tile", True, "no matrix units"), (both, False, "refuses"), (both, True, "")):
        monkeypatch.setattr(amx, "cpu_flags", lambda flags=flags: frozenset(flags.split()))
        monkeypatch.setattr(amx, "request_tiles", lambda allowed=allowed: allowed)
        assert words in amx.missing(pocl)
        assert bool(amx.missing(pocl)) == bool(words)
    other = SimpleNamespace(platform=SimpleNamespace(name="Oclgrind"), name="Oclgrind Simulator", type=cl.device_type.CPU)
    assert "compiler" in amx.missing(Properties(other))


def test_that_it_is_emulated_is_said(processor, monkeypatch):
    lines = []
    monkeypatch.setattr(selection, "choose", lambda name, tell, trial: processor)
    monkeypatch.setattr(amx, "missing", lambda _: "no matrix units")
    open_backend("cl", zeros(), ComputeOptions(precision="bfloat16"), tell=lines.append)
    assert lines == ["bfloat16: no matrix units; emulated, which is slow"]
    open_backend("cl", zeros(), ComputeOptions(), tell=lines.append)
    assert len(lines) == 1


@pytest.mark.thorough
def test_the_last_layer_writes_the_image(processor, unoptimised, units, monkeypatch):
    """As the kernel that reads its result, but for outc's weights, two bfloat16 each: they lose 2**-17 of themselves, sums of 48 products
    2**-24 each."""
    inputs, images, weights = network_inputs((13, 75), 3), [], random_weights(3)
    for fused in (True, False):
        monkeypatch.setattr(
            layers, "plan_network", lambda *a, is_fused=fused, **rest: plan_network(*a, **{**rest, "fused": is_fused})
        )
        network = Network(weights, processor, "bfloat16")
        images.append(network(*inputs))
        assert (network.layers(13, 75).launches[-1].name == "image") == (not fused)
    feature = network.layers(13, 75).launches[-1].arguments["feature"]
    features = np.empty(feature.size // 2, np.uint16)
    cl.enqueue_copy(processor.queue, features, feature)
    absolute = np.abs(weights["outc.weight"]).sum(axis=1).max() * from_bfloat16(features).max() + np.abs(images[0]).max()
    assert 0 < np.abs(images[0] - images[1]).max() <= (2.0**-17 + 2 * 50 * 2.0**-24) * absolute
