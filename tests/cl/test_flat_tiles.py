# SPDX-License-Identifier: MIT
"""Flat tiles: which they are, and what leaving them to the upsampled frame does to the others."""

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from conformance.tolerance import ratio
from stss_cl.device.buffers import Outgoing, incoming
from stss_cl.device.parts import zeroed
from stss_cl.network.layers import Layers
from stss_cl.network.network import PRECISIONS
from stss_cl.skip.flat_tiles import FlatTiles
from stss_cl.skip.partial_network import PartialNetwork
from stss_ref.resample import upsample_centres
from tests.cl.test_stream import WEIGHTS

FLAT, SURFACE, EDGE = 0.01, 0.1, 3
SIZE = (77, 100)
PADDED = (80, 104)


def picture(seed: int, *, plain: bool) -> list[np.ndarray]:
    """What the network reads; ``plain``: the colour is a ramp but for some marks, and the frame has some holes."""
    rng = np.random.default_rng(seed)
    color, gbuffer = rng.random((*SIZE, 6), np.float32), rng.random((*SIZE, 9), np.float32)
    mask, history = np.ones(SIZE, np.float32), rng.random((3, *SIZE, 4), np.float32)
    if plain:
        y, x = np.indices(SIZE, np.float32)
        gbuffer[...] = 0.5
        color[..., :3] = (0.004 * y + 0.003 * x)[..., None]
        for _ in range(3):
            at = int(rng.integers(2, SIZE[0] - 3)), int(rng.integers(2, SIZE[1] - 3))
            color[at[0] : at[0] + int(rng.integers(1, 6)), at[1]] += np.float32(rng.choice([0.4 * FLAT, 0.02, 0.3]))
            gbuffer[int(rng.integers(SIZE[0])), int(rng.integers(SIZE[1])), int(rng.integers(9))] += np.float32(
                rng.choice([0.04, 0.2])
            )
            mask[int(rng.integers(SIZE[0])), int(rng.integers(SIZE[1]))] = 0
    return [color, gbuffer, mask, history]


def tiles(values: np.ndarray) -> np.ndarray:
    """The largest value of each tile of 4 x 4."""
    rows, columns = values.shape
    return values.reshape(rows // 4, 4, columns // 4, 4).max(axis=(1, 3))


def bent(values: np.ndarray, limit: float) -> np.ndarray:
    """Where a second difference along an axis exceeds the limit, padded."""
    beyond = [(0, p - s) for p, s in zip(PADDED, SIZE, strict=True)]
    padded = np.pad(values.astype(np.float64), [*beyond, (0, 0)], mode="edge")
    across, down = (np.abs(ndimage.convolve1d(padded, [1, -2, 1], axis=axis, mode="nearest")).max(axis=-1) for axis in (0, 1))
    return np.maximum(across, down) > limit


def expected(color: np.ndarray, gbuffer: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Which tiles are no flat ones, by SciPy."""
    hole = np.pad(mask == 0, [(0, p - s) for p, s in zip(PADDED, SIZE, strict=True)])
    found = tiles(ndimage.maximum_filter(bent(color[..., :3], FLAT) | bent(gbuffer, SURFACE) | hole, 3))
    found = ndimage.maximum_filter(found, 3)
    y, x = np.indices(found.shape)
    inner = (y >= EDGE) & (x >= EDGE) & (4 * (y + EDGE) < SIZE[0]) & (4 * (x + EDGE) < SIZE[1])
    return found | ~inner


class Setup:
    """The network for SIZE, with flat tiles."""

    def __init__(self, device, precision):
        self.device, self.precision = device, precision
        self.layers = Layers(device, WEIGHTS, *SIZE, precision, keep=True)
        self.mask = zeroed(device, SIZE[0] * SIZE[1])
        self.flat = FlatTiles(device, self.layers.launches, self.layers.inputs, self.mask, SIZE, FLAT)
        self.network, self.held = PartialNetwork(self.layers), []

    def __call__(self, arrays, *, leave_out=False):
        self.held = [incoming(self.device, array) for array in arrays], arrays
        cl.enqueue_copy(self.device.queue, self.mask, (arrays[2] != 0).astype(np.uint8))
        self.layers.pack(*self.held[0])
        image = Outgoing(self.device, (2 * SIZE[0], 2 * SIZE[1], 3), on_device=False)
        self.flat.read(self.held[0][1])
        self.network.run(image.data, self.flat if leave_out else None)
        self.departure = None if leave_out else self.flat.departure(image.data)
        return image.finish().copy()


@pytest.fixture(scope="module", params=PRECISIONS)
def setup(request, device):
    return Setup(device, request.param)


@given(seed=st.integers(0, 2**16))
def test_which_tiles_are_flat(setup, seed):
    arrays = picture(seed, plain=True)
    setup(arrays, leave_out=True)
    want = expected(*arrays[:3])
    np.testing.assert_array_equal(setup.flat.wanted(), want)
    assert not want.all()
    for fine, coarse in zip(setup.flat.maps(), setup.flat.maps()[1:], strict=False):
        rows, columns = coarse.shape
        grown = ndimage.maximum_filter(
            np.pad(fine, [(0, 2 * n - m) for n, m in zip((rows, columns), fine.shape, strict=True)]), 3
        )
        np.testing.assert_array_equal(coarse, grown.reshape(rows, 2, columns, 2).max(axis=(1, 3)))


def test_the_rest_of_the_image_is_that_of_the_whole_network(setup):
    """What is no flat tile is as by the whole network, whatever the layers held before; the others are the upsampled frame."""
    arrays = picture(1, plain=True)
    whole = setup(arrays)
    setup(picture(2, plain=False))
    got = setup(arrays, leave_out=True)
    height, width, _ = got.shape
    wanted = setup.flat.wanted().repeat(8, axis=0).repeat(8, axis=1)[:height, :width]
    assert 0.1 < wanted.mean() < 0.9
    np.testing.assert_array_equal(got[~wanted], upsample_centres(arrays[0][..., :3])[~wanted])
    assert not np.array_equal(got[~wanted], whole[~wanted])
    if setup.precision == "float32-direct":
        np.testing.assert_array_equal(got[wanted], whole[wanted])
    # A Winograd tile rounds what lies around its own pixels, too.
    assert ratio(f"network.cl.{setup.precision}", got[wanted], whole[wanted]) <= 1


@given(seed=st.integers(0, 2**16))
def test_the_departure_is_seen_in_the_whole_image(setup, seed):
    """Without computing it: how far the flat tiles' pixels lie from the upsampled frame, in the image of the whole network."""
    arrays = picture(seed, plain=True)
    whole = setup(arrays)
    height, width, _ = whole.shape
    plain = ~expected(*arrays[:3]).repeat(8, axis=0).repeat(8, axis=1)[:height, :width]
    assert setup.departure == np.abs(whole - upsample_centres(arrays[0][..., :3]))[plain].max() > 0


def test_without_flat_tiles_nothing_is_left_out(setup):
    arrays = picture(3, plain=False)
    whole = setup(arrays)
    assert setup.departure == 0
    setup(picture(2, plain=True))
    np.testing.assert_array_equal(setup(arrays, leave_out=True), whole)
    assert setup.flat.wanted().all()
