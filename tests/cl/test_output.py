"""From the network's image to the caller's: planes carried past it bit for bit, the sRGB curve within its bound."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conformance.cases.planes import SEEDS, motions, sizes
from stss.frames.carried_planes import HIGHLIGHTS, WHITE, carry
from stss.frames.display_frame import OnHost
from stss.images.color import transfer
from stss_cl.image_space.output import CURVE_ERROR, OutputKernels
from stss_ref.arrays import ArrayError

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
    got = output.deliver(values.reshape(2, -1, 3), {}, None, srgb=True)[0].reshape(-1)
    assert (np.abs(got - linear(values)) <= CURVE_ERROR * linear(values)).all()
    assert (np.diff(got) >= 0).all()
    assert got[0] == 0
    assert got[-1] == 1


@settings(max_examples=40)
@given(size=sizes(), seed=SEEDS, srgb=st.booleans(), bright=st.booleans(), extrapolated=st.booleans())
def test_an_image_comes_back_as_the_reference_has_it(output, size, seed, srgb, bright, extrapolated):
    """Beyond [0, 1] too; white pixels get their highlights; without a curve the bits are the same."""
    random, display = np.random.default_rng(seed), (2 * size[0], 2 * size[1], 3)
    image = random.uniform(-0.2, 1.2, display).astype(np.float32)
    above = np.where(random.random((*size, 3)) < 0.5, random.uniform(0, 65503, (*size, 3)), 0).astype(np.float32)
    before, planes = image.copy(), {HIGHLIGHTS: above} if bright else {}
    motion = random.uniform(-3, 3, (*size, 2)).astype(np.float32) if extrapolated else None
    got, none = output.deliver(image, planes, motion, srgb=srgb, highlights=HIGHLIGHTS, white=WHITE)
    want, _ = OnHost().deliver(image, transfer("srgb" if srgb else "none"), planes, motion)
    assert none == {}
    if srgb:
        # The share of a highlight is a quotient, which OpenCL rounds to 2.5 units in the last place; a product and a sum follow.
        assert (np.abs(got - want.astype(np.float64)) <= (CURVE_ERROR + 8 * UNIT) * want).all()
    elif not bright:
        np.testing.assert_array_equal(got, want)
    np.testing.assert_array_equal(image, before)


@settings(max_examples=40)
@given(size=sizes(), channels=st.integers(1, 4), seed=SEEDS, data=st.data())
def test_a_plane_is_carried_with_the_references_bits(output, size, channels, seed, data):
    """Of any number of channels, moved and not; what the caller has stays, and what it gets is its own."""
    plane = np.random.default_rng(seed).normal(0, 100, (*size, channels)).astype(np.float32)
    motion = data.draw(motions(size)).astype(np.float32)
    image = np.zeros((2 * size[0], 2 * size[1], 3), np.float32)
    answers = [
        (output.deliver(image, {"a": plane, "b": -plane}, each, srgb=False)[1], carry(plane, each))
        for each in (motion, None, motion)
    ]
    for got, want in answers:
        assert [each.dtype for each in got.values()] == [np.float32] * 2
        np.testing.assert_array_equal(got["a"], want)
        np.testing.assert_array_equal(got["b"], -want)


@settings(max_examples=40)
@given(size=sizes(), seed=SEEDS, data=st.data())
def test_an_image_that_is_not_finite_is_refused(output, size, seed, data):
    """Wherever it is, and the next one is delivered."""
    image = np.random.default_rng(seed).random((2 * size[0], 2 * size[1], 3), np.float32)
    place = data.draw(st.integers(0, image.size - 1))
    broken = image.copy()
    broken.flat[place] = data.draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    with pytest.raises(ArrayError, match=r"image: 1 non-finite"):
        output.deliver(broken, {}, None, srgb=True)
    np.testing.assert_array_equal(output.deliver(image, {}, None, srgb=False)[0], image)
