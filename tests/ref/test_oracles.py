"""The reference against other implementations, in float64: SciPy's, and sums over windows where the reference sums over taps."""

import numpy as np
import scipy.ndimage
import scipy.special
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.stride_tricks import sliding_window_view

from conformance.cases.planes import SEEDS, frames, motions, sizes
from conformance.tolerance import ratio
from stss_ref.accumulate import accumulate
from stss_ref.erm import attend, divide, normalise
from stss_ref.loss import loss
from stss_ref.network import network
from stss_ref.sample import follow, leads_inside
from stss_ref.warp import warp
from stss_ref.weights import astype
from stss_ref.weights import random as random_weights


def windows(x, side):
    """(H, W, C, side * side): what lies in the window around each pixel, 0 outside the frame."""
    r = side // 2
    return sliding_window_view(np.pad(x, ((r, r), (r, r), (0, 0))), (side, side), (0, 1)).reshape(*x.shape, -1)


def relu(x):
    return np.maximum(x, 0)


def zoomed(x, *, centres):
    """(2H, 2W, C) bilinear, on the grid of pixel centres or of corner pixels."""
    return scipy.ndimage.zoom(x, (2, 2, 1), order=1, mode="nearest", grid_mode=centres)


def eighth(x):
    """(H / 8, W / 8, C): read at the centres of the 8 x 8 blocks."""
    y, x_, c = np.indices((x.shape[0] // 8, x.shape[1] // 8, x.shape[2]))
    return scipy.ndimage.map_coordinates(x, [8 * y + 3.5, 8 * x_ + 3.5, c], order=1)


def shuffled(x):
    """(2H, 2W, C / 4): one channel after the other."""
    image = np.empty((2 * x.shape[0], 2 * x.shape[1], x.shape[2] // 4))
    for n in range(x.shape[2]):
        image[n // 2 % 2 :: 2, n % 2 :: 2, n // 4] = x[..., n]
    return image


@given(data=st.data(), size=sizes())
def test_accumulate_is_rank_filters_around_map_coordinates(data, size):
    display = tuple(2 * n for n in size)
    image, *earlier = (data.draw(frames(display, 2)) for _ in range(data.draw(st.integers(2, 3))))
    moved = [data.draw(motions(size)) for _ in earlier]
    got = accumulate(image, np.stack(earlier), np.stack(moved))
    for c in range(2):
        low, high = (f(image[..., c], 3, mode="nearest") for f in (scipy.ndimage.minimum_filter, scipy.ndimage.maximum_filter))
        want = image[..., c]
        for before, motion, share in zip(earlier, moved, (1 / 4, 1 / 8), strict=False):
            y, x = np.indices(display) + np.moveaxis(2 * np.kron(motion, np.ones((2, 2, 1))), -1, 0)[::-1]
            history = np.clip(scipy.ndimage.map_coordinates(before[..., c], [y, x], order=1, mode="nearest"), low, high)
            inside = (x >= 0) & (x <= display[1] - 1) & (y >= 0) & (y <= display[0] - 1)
            slow = np.minimum(1, 4 / np.maximum(np.hypot(*np.moveaxis(motion, -1, 0)), 1e-30)) ** 2
            want = want + np.where(inside, history - image[..., c], 0) * share * np.kron(slow, np.ones((2, 2)))
        peak = max(np.abs(image).max(), np.abs(earlier).max())
        assert ratio("warp.warped", got[..., c], want, max(display) * peak) <= 1


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


def attend_windows(query, key, value):
    """The authors' way: unfold the 5 x 5 windows, then a batched product."""
    w = np.maximum(np.einsum("yxck,yxc->yxk", windows(key, 5), query), 0)
    return np.einsum("yxck,yxk->yxc", windows(value, 5), w) / np.maximum(w.sum(-1), 1e-6)[..., None]


def attention_scale(query, key, value):
    """What a rounding of 1 can move the quotient by: ``(d N + |N / D| d D) / D`` with N and D on absolute values."""
    w = np.einsum("yxck,yxc->yxk", windows(np.abs(key), 5), np.abs(query))
    v = windows(np.abs(value), 5)
    d = np.maximum(np.einsum("yxck,yxc->yxk", windows(key, 5), query), 0).sum(-1)
    n = np.einsum("yxck,yxk->yxc", v, w)
    return (n + v.max(-1) * w.sum(-1)[..., None]) / np.maximum(d, 1e-6)[..., None]


@given(size=sizes(9), seed=SEEDS, share=st.sampled_from([0.0, 0.1, 0.9, 1.0]))
def test_attention_is_a_sum_over_windows(size, seed, share):
    random = np.random.default_rng(seed)
    query, value = random.normal(size=(*size, 32)), random.normal(size=(*size, 7))
    key = query * (random.random(size) < share)[..., None]
    scale = attention_scale(query, key, value)
    assert ratio("erm.attend", attend(query, key, value), attend_windows(query, key, value), scale) <= 1


class WindowNetwork:
    """STSSNet from the specification's section 7, not from ``stss_ref``: each convolution one product over windows."""

    def __init__(self, weights):
        self.w = weights

    def conv(self, x, name, stride=1):
        w = self.w[f"{name}.weight"]
        taps = windows(x, w.shape[-1])[::stride, ::stride]
        return np.tensordot(taps, w.reshape(*w.shape[:2], -1), ((2, 3), (1, 2))) + self.w[f"{name}.bias"]

    def gated(self, x, name, stride=1):
        return self.conv(x, f"{name}.conv_feature", stride) * scipy.special.expit(self.conv(x, f"{name}.conv_mask.0", stride))

    def chain(self, x, name, stride=1, last=True):
        x = relu(self.conv(x, f"{name}.0", stride))
        x = self.conv(relu(self.conv(x, f"{name}.2")), f"{name}.4")
        return relu(x) if last else x

    def down(self, x, name):
        x = self.gated(x, f"{name}.downsample", 2)
        return relu(self.gated(relu(self.gated(x, f"{name}.conv1")), f"{name}.conv2"))

    def up(self, x, skip, name):
        x = np.concatenate([skip, zoomed(x, centres=False)], -1)
        name = f"{name}.conv.double_conv"
        return relu(self.conv(relu(self.conv(x, f"{name}.0")), f"{name}.2"))

    def erm(self, x4, gbuffer, mask):
        f, m = eighth(gbuffer), eighth(mask)
        v = self.chain(np.concatenate([x4, f], -1), "latentEncoder", last=False) * m
        k = self.chain(f, "KEncoder", last=False)
        k = k / np.maximum(np.linalg.norm(k, axis=-1, keepdims=True), 1e-12)
        return attend_windows(k, k * m, v)

    def __call__(self, color, gbuffer, mask, history):
        height, width = color.shape[:2]
        y, x = np.ix_(
            np.minimum(np.arange(-(-height // 8) * 8), height - 1), np.minimum(np.arange(-(-width // 8) * 8), width - 1)
        )
        color, gbuffer, mask, *history = (plane[y, x] for plane in (color, gbuffer, mask, *history))
        x1 = relu(self.gated(relu(self.gated(np.concatenate([color, color * mask, gbuffer], -1), "conv1")), "conv2"))
        x2 = self.down(x1, "down1")
        x3 = self.down(x2, "down2")
        x4 = self.down(x3, "down3")
        embedded = [self.chain(self.chain(self.chain(h, "convHis1", 2), "convHis2", 2), "convHis3", 2) for h in history]
        x = np.concatenate([self.erm(x4, gbuffer, mask), self.gated(np.concatenate(embedded, -1), "lowlevelGated")], -1)
        x = self.up(self.up(self.up(x, x3, "up1"), x2, "up2"), x1, "up3")
        image = shuffled(self.conv(x, "outc")) + zoomed(color[..., :3], centres=True)
        return image[: 2 * height, : 2 * width]


@settings(max_examples=10)
@given(size=sizes(25), seed=SEEDS)
def test_the_network_is_that_of_windows_with_any_weights_and_size(size, seed):
    random = np.random.default_rng(seed)
    weights = astype(random_weights(seed), np.float64)
    color, gbuffer, history = (random.random((*n, *size, c)) for n, c in (((), 6), ((), 9), ((3,), 4)))
    mask = (random.random(size) < 0.7).astype(np.float64)
    got = network(color, gbuffer, mask, history, weights)
    assert ratio("network.float64", got, WindowNetwork(weights)(color, gbuffer, mask[..., None], history)) <= 1


@settings(max_examples=30)
@given(size=sizes(12), seed=SEEDS, share=st.sampled_from([0.0, 0.5, 1.0]))
def test_the_loss_is_a_mean_and_one_of_the_holes(size, seed, share):
    random = np.random.default_rng(seed)
    output, truth = (random.random((2 * size[0], 2 * size[1], 3)) for _ in range(2))
    mask = (random.random(size) < share).astype(np.float64)
    hole = np.broadcast_to(zoomed(mask[..., None], centres=True) == 0, truth.shape)
    error = np.abs(output - truth)
    assert loss(truth, truth, mask) == 0
    want = error.mean() + (error[hole].mean() if hole.any() else 0) + 0.01 * 0.25
    got = np.array(loss(output, truth, mask, perceptual=0.25))
    assert ratio("metric.sum", got, np.array(want), 3.0) <= 1


def test_the_least_length_and_the_least_sum():
    """1e-13 over the least length 1e-12 is 0.1, and so is 1e-7 over the least sum 1e-6."""
    np.testing.assert_array_equal(normalise(np.array([[[0, 1e-13]]])), [[[0, 1e-13 / 1e-12]]])
    np.testing.assert_array_equal(normalise(np.array([[[0, 1e-11]]])), [[[0, 1]]])
    np.testing.assert_array_equal(divide(np.array([[[1e-7]]]), np.array([[[1e-7]]])), [[[1e-7 / 1e-6]]])
    np.testing.assert_array_equal(divide(np.array([[[3e-5]]]), np.array([[[1e-5]]])), [[[3e-5 / 1e-5]]])
