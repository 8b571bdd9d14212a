"""The reference against independent implementations: SciPy and PyTorch, in float64."""

import numpy as np
import pytest
import scipy.ndimage
from hypothesis import given, settings
from hypothesis import strategies as st

from conformance.cases.planes import SEEDS, frames, motions, sizes
from conformance.tolerance import ratio, sum_bound, worst
from stss_ref.conv import conv
from stss_ref.erm import attend, erm
from stss_ref.loss import loss
from stss_ref.network import network
from stss_ref.resample import downsample_8, pixel_shuffle, upsample_centres, upsample_corners
from stss_ref.sample import follow, leads_inside
from stss_ref.warp import warp
from stss_ref.weights import astype
from stss_ref.weights import random as random_weights

torch = pytest.importorskip("torch", reason="the oracle PyTorch is not installed: pip install '.[test]'")
F = torch.nn.functional
torch.set_num_threads(1)


def to_torch(x):
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(x, -1, 0)))[None]


def to_numpy(x):
    return np.moveaxis(x[0].numpy(), 0, -1)


@given(data=st.data(), size=sizes())
def test_warp_is_map_coordinates(data, size):
    color = data.draw(frames(size, 2))
    motion = data.draw(motions(size))
    warped, inside = warp(color, motion)
    y, x = np.indices(size) + np.moveaxis(motion, -1, 0)[::-1]
    want = [scipy.ndimage.map_coordinates(color[..., c], [y, x], order=1, mode="nearest") for c in range(2)]
    # A position of 1e12 pixels is clamped before it is used: only those near the frame lose anything.
    assert ratio("warp.warped", warped, np.stack(want, -1), max(size) * np.abs(color).max()) <= 1
    np.testing.assert_array_equal(inside, (x >= 0) & (x <= size[1] - 1) & (y >= 0) & (y <= size[0] - 1))
    np.testing.assert_array_equal(leads_inside(follow(motion)), inside)


@given(
    size=sizes(), inputs=st.integers(1, 5), outputs=st.integers(1, 5), stride=st.sampled_from([1, 2]),
    kernel=st.sampled_from([1, 3]), seed=SEEDS,
)  # fmt: skip
def test_conv_is_torch_and_correlate(size, inputs, outputs, stride, kernel, seed):
    random = np.random.default_rng(seed)
    x, w = random.normal(size=(*size, inputs)), random.normal(size=(outputs, inputs, kernel, kernel))
    b = random.normal(size=outputs)
    allowed = sum_bound(kernel**2 * inputs + 2, conv(np.abs(x), np.abs(w), np.abs(b), stride), np.float64)
    got = conv(x, w, b, stride)

    tensors = to_torch(x), torch.from_numpy(w), torch.from_numpy(b)
    assert worst(np.abs(got - to_numpy(F.conv2d(*tensors, stride=stride, padding=kernel // 2))), allowed) <= 1

    whole = np.stack(
        [b[o] + sum(scipy.ndimage.correlate(x[..., c], w[o, c], mode="constant") for c in range(inputs)) for o in range(outputs)],
        axis=-1,
    )
    assert worst(np.abs(got - whole[::stride, ::stride]), allowed) <= 1


@given(data=st.data(), size=sizes())
def test_both_grids_are_torchs(data, size):
    x = data.draw(frames(size, 2))
    for upsample, corners in ((upsample_corners, True), (upsample_centres, False)):
        want = to_numpy(F.interpolate(to_torch(x), scale_factor=2, mode="bilinear", align_corners=corners))
        # Two positions of up to `side` pixels, each rounded, times a contrast of at most the peak.
        assert ratio("resample.upsampled", upsample(x), want, (1 + max(size)) * np.abs(x).max()) <= 1


@given(data=st.data(), eighths=sizes(4))
def test_an_eighth_is_torchs(data, eighths):
    x = data.draw(frames((8 * eighths[0], 8 * eighths[1]), 2))
    want = to_numpy(F.interpolate(to_torch(x), size=eighths, mode="bilinear", align_corners=False))
    assert ratio("resample.downsampled", downsample_8(x), want, np.abs(x).max()) <= 1


@given(data=st.data(), size=sizes())
def test_pixel_shuffle_is_torchs(data, size):
    x = data.draw(frames(size, 12))
    np.testing.assert_array_equal(pixel_shuffle(x), to_numpy(F.pixel_shuffle(to_torch(x), 2)))


def unfold_attention(query, key, value):
    """The authors' way: unfold the 5 x 5 windows, then a batched product."""
    height, width, channels = query.shape
    k = F.unfold(to_torch(key), 5, padding=2).view(channels, 25, height * width)
    v = F.unfold(to_torch(value), 5, padding=2).view(value.shape[-1], 25, height * width)
    q = torch.from_numpy(query).reshape(height * width, channels).T
    w = torch.relu(torch.einsum("ckn,cn->kn", k, q))
    total = torch.einsum("ckn,kn->nc", v, w) / w.sum(0).clamp(min=1e-6)[:, None]
    return total.reshape(height, width, -1).numpy()


def attention_scale(query, key, value):
    """What a rounding of 1 can move the quotient by: ``(d N + |N / D| d D) / D`` with N and D on absolute values."""
    height, width, channels = query.shape
    windows = F.unfold(to_torch(np.abs(key)), 5, padding=2).view(channels, 25, -1)
    w = torch.einsum("ckn,cn->kn", windows, torch.from_numpy(np.abs(query)).reshape(-1, channels).T)
    v = F.unfold(to_torch(np.abs(value)), 5, padding=2).view(value.shape[-1], 25, -1)
    exact = F.unfold(to_torch(key), 5, padding=2).view(channels, 25, -1)
    d = torch.relu(torch.einsum("ckn,cn->kn", exact, torch.from_numpy(query).reshape(-1, channels).T)).sum(0)
    n = torch.einsum("ckn,kn->cn", v, w)
    scale = (n + v.amax(1) * w.sum(0)) / d.clamp(min=1e-6)
    return scale.T.reshape(height, width, -1).numpy()


@given(size=sizes(9), seed=SEEDS, share=st.sampled_from([0.0, 0.1, 0.9, 1.0]))
def test_attention_is_unfolds(size, seed, share):
    random = np.random.default_rng(seed)
    query, value = random.normal(size=(*size, 32)), random.normal(size=(*size, 7))
    key = query * (random.random(size) < share)[..., None]
    scale = attention_scale(query, key, value)
    assert ratio("erm.attend", attend(query, key, value), unfold_attention(query, key, value), scale) <= 1


class TorchNetwork:
    """STSSNet by PyTorch's own functions, written from the specification's section 7, not from ``stss_ref``."""

    def __init__(self, weights):
        self.w = {name: torch.tensor(array) for name, array in weights.items()}

    def conv(self, x, name, stride=1):
        w = self.w[f"{name}.weight"]
        return F.conv2d(x, w, self.w[f"{name}.bias"], stride, w.shape[-1] // 2)

    def gated(self, x, name, stride=1):
        return self.conv(x, f"{name}.conv_feature", stride) * torch.sigmoid(self.conv(x, f"{name}.conv_mask.0", stride))

    def chain(self, x, name, stride=1, last=True):
        x = F.relu(self.conv(x, f"{name}.0", stride))
        x = self.conv(F.relu(self.conv(x, f"{name}.2")), f"{name}.4")
        return F.relu(x) if last else x

    def down(self, x, name):
        x = self.gated(x, f"{name}.downsample", 2)
        return F.relu(self.gated(F.relu(self.gated(x, f"{name}.conv1")), f"{name}.conv2"))

    def up(self, x, skip, name):
        x = torch.cat([skip, F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)], 1)
        name = f"{name}.conv.double_conv"
        return F.relu(self.conv(F.relu(self.conv(x, f"{name}.0")), f"{name}.2"))

    def erm(self, x4, gbuffer, mask):
        f, m = (F.interpolate(x, scale_factor=0.125, mode="bilinear", align_corners=False) for x in (gbuffer, mask))
        v = self.chain(torch.cat([x4, f], 1), "latentEncoder", last=False) * m
        k = F.normalize(self.chain(f, "KEncoder", last=False))
        return to_torch(unfold_attention(*map(to_numpy, (k, k * m, v))))

    def __call__(self, color, gbuffer, mask, history):
        height, width = color.shape[-2:]
        pad = (0, -width % 8, 0, -height % 8)
        color, gbuffer, mask = (F.pad(x, pad, mode="replicate") for x in (color, gbuffer, mask))
        history = [F.pad(x, pad, mode="replicate") for x in history]
        x = torch.cat([color, color * mask, gbuffer], 1)
        x1 = F.relu(self.gated(F.relu(self.gated(x, "conv1")), "conv2"))
        x2 = self.down(x1, "down1")
        x3 = self.down(x2, "down2")
        x4 = self.down(x3, "down3")
        embedded = [self.chain(self.chain(self.chain(h, "convHis1", 2), "convHis2", 2), "convHis3", 2) for h in history]
        x = torch.cat([self.erm(x4, gbuffer, mask), self.gated(torch.cat(embedded, 1), "lowlevelGated")], 1)
        x = self.up(self.up(self.up(x, x3, "up1"), x2, "up2"), x1, "up3")
        residual = F.pixel_shuffle(self.conv(x, "outc"), 2)
        image = residual + F.interpolate(color[:, :3], scale_factor=2, mode="bilinear", align_corners=False)
        return image[..., : 2 * height, : 2 * width]


@settings(max_examples=30)
@given(size=sizes(25), seed=SEEDS)
def test_the_network_is_torchs_with_any_weights_and_size(size, seed):
    random = np.random.default_rng(seed)
    weights = astype(random_weights(seed), np.float64)
    color, gbuffer, history = (random.random((*n, *size, c)) for n, c in (((), 6), ((), 9), ((3,), 4)))
    mask = (random.random(size) < 0.7).astype(np.float64)
    got = network(color, gbuffer, mask, history, weights)
    want = TorchNetwork(weights)(*map(to_torch, (color, gbuffer, mask[..., None])), [to_torch(h) for h in history])
    assert ratio("network.float64", got, to_numpy(want)) <= 1


@settings(max_examples=30)
@given(size=sizes(12), seed=SEEDS, share=st.sampled_from([0.0, 0.5, 1.0]))
def test_the_loss_is_torchs(size, seed, share):
    random = np.random.default_rng(seed)
    output, truth = (random.random((2 * size[0], 2 * size[1], 3)) for _ in range(2))
    mask = (random.random(size) < share).astype(np.float64)
    o, y = to_torch(output), to_torch(truth)
    up = F.interpolate(to_torch(mask[..., None]), scale_factor=2, mode="bilinear", align_corners=False)
    hole = (1 - (up > 0).double()).expand_as(o)
    want = (o - y).abs().mean() + ((o - y).abs() * hole).sum() / hole.sum().clamp(min=1e-6) + 0.01 * 0.25
    got = np.array(loss(output, truth, mask, perceptual=0.25))
    assert ratio("metric.sum", got, np.array(want.item()), 3.0) <= 1


@pytest.mark.parametrize("mutate", ["key unmasked", "half-pixel grid"])
def test_an_oracle_can_fail(mutate):
    """The comparison above sees a planted fault."""
    random = np.random.default_rng(0)
    if mutate == "half-pixel grid":
        x = random.random((6, 7, 2))
        want = to_numpy(F.interpolate(to_torch(x), scale_factor=2, mode="bilinear", align_corners=True))
        assert ratio("resample.upsampled", upsample_centres(x), want, 8) > 1
        return
    query, value = random.normal(size=(6, 7, 32)), random.normal(size=(6, 7, 3))
    key = query * (random.random((6, 7)) < 0.5)[..., None]
    assert (
        ratio(
            "erm.attend",
            attend(query, query, value),
            unfold_attention(query, key, value),
            attention_scale(query, key, value),
        )
        > 1
    )


@given(size=sizes(9), seed=SEEDS)
def test_a_masked_value_never_reaches_the_attention(size, seed):
    """What lies in a warping hole has no influence, however large: bit for bit."""
    random = np.random.default_rng(seed)
    query, value = random.normal(size=(*size, 32)), random.normal(size=(*size, 3))
    mask = random.random(size) < 0.5
    elsewhere = np.where(mask[..., None], value, 1e6 * random.normal(size=value.shape))
    key = query * mask[..., None]
    np.testing.assert_array_equal(attend(query, key, value), attend(query, key, elsewhere))


def test_all_hole_reshades_to_nothing():
    random = np.random.default_rng(1)
    weights = astype(random_weights(1), np.float64)
    reshaded = erm(random.random((4, 5, 32)), random.random((32, 40, 9)), np.zeros((32, 40)), weights)
    np.testing.assert_array_equal(reshaded, np.zeros((4, 5, 64)))
