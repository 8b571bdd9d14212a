"""From the network's image to the caller's: planes carried past it bit for bit, the sRGB curve within its bound."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conformance.cases.planes import SEEDS, motions, sizes
from stss.frames.carried_planes import WHITE, carry
from stss.frames.display_frame import OnHost
from stss.images.color import transfer
from stss_cl.image_space.output import CURVE_ERROR, OutputKernels

UNIT = 2.0**-24
"""Largest relative error of a rounded number."""
BREAK = np.float32(12.92 * 0.0031308)
"""Where its two pieces meet."""


@pytest.fixture(scope="module")
def output(device):
    return OutputKernels(device)


def linear(e):
    """The inverse of the sRGB curve, in float64 (IEC 61966-2-1)."""
    e = e.astype(np.float64)
    return np.where(e <= 12.92 * 0.0031308, e / 12.92, ((e + 0.055) / 1.055) ** 2.4)


def test_the_curve_is_within_its_bound(output):
    """At a million values of all magnitudes, at both sides of the break, and it never falls."""
    around = (BREAK.view(np.int32) + np.arange(-20, 21, dtype=np.int32)).view(np.float32)
    # From 2e-37 on: a smaller quotient would be subnormal, and so 0.
    values = np.concatenate([np.geomspace(2e-37, 1, 1 << 19), np.linspace(0, 1, 1 << 20), around])
    values = np.unique(values.astype(np.float32))
    values = np.concatenate([values, np.ones(-len(values) % 24, np.float32)])
    got = output.decode(values.reshape(2, -1, 3), WHITE, srgb=True, above=None).reshape(-1)
    assert (np.abs(got - linear(values)) <= CURVE_ERROR * linear(values)).all()
    assert (np.diff(got) >= 0).all()
    assert got[0] == 0
    assert got[-1] == 1


@settings(max_examples=40)
@given(size=sizes(), seed=SEEDS, srgb=st.booleans(), bright=st.booleans())
def test_an_image_comes_back_as_the_reference_has_it(output, size, seed, srgb, bright):
    """Beyond [0, 1] too; white pixels get their highlights; without a curve the bits are the same."""
    random, display = np.random.default_rng(seed), (2 * size[0], 2 * size[1], 3)
    image = random.uniform(-0.2, 1.2, display).astype(np.float32)
    above = np.where(random.random(display) < 0.5, random.uniform(0, 65503, display), 0).astype(np.float32) if bright else None
    before = image.copy()
    got = output.decode(image, WHITE, srgb=srgb, above=above)
    want = OnHost().decode(image, transfer("srgb" if srgb else "none"), above)
    if srgb:
        # The share of a highlight is a quotient, which OpenCL rounds to 2.5 units in the last place; a product and a sum follow.
        assert (np.abs(got - want.astype(np.float64)) <= (CURVE_ERROR + 8 * UNIT) * want).all()
    elif above is None:
        np.testing.assert_array_equal(got, want)
    np.testing.assert_array_equal(image, before)


@settings(max_examples=40)
@given(size=sizes(), channels=st.integers(1, 4), seed=SEEDS, data=st.data())
def test_a_plane_is_carried_with_the_references_bits(output, size, channels, seed, data):
    """Of any number of channels, moved and not; what the caller has stays, and what it gets is its own."""
    plane = np.random.default_rng(seed).normal(0, 100, (*size, channels)).astype(np.float32)
    motion = data.draw(motions(size)).astype(np.float32)
    answers = [(output.carry(plane, each), carry(plane, each)) for each in (motion, None, motion)]
    for got, want in answers:
        assert got.dtype == np.float32
        np.testing.assert_array_equal(got, want)


def test_threads_take_turns(output):
    """Each gets its own image."""
    images = [np.full((16, 24, 3), n / 64, np.float32) for n in range(64)]
    with ThreadPoolExecutor(8) as pool:
        got = list(pool.map(lambda image: output.decode(image, WHITE, srgb=False, above=None), images))
    for each, image in zip(got, images, strict=True):
        np.testing.assert_array_equal(each, image)
