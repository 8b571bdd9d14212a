# SPDX-License-Identifier: MIT
"""Transfers (spec section 9)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from stss.images.color import BLOCK, TRANSFERS, transfer
from stss_ground.errors import InputError
from stss_ref.arrays import ArrayError

quick = settings(deadline=None, max_examples=50)
names = st.sampled_from(TRANSFERS)
sizes = st.tuples(st.integers(1, 5), st.integers(1, 5), st.just(3))


@st.composite
def images(draw, largest):
    """Drawn numbers, or ones of all magnitudes from a drawn seed: drawn ones are simple and seldom round."""
    size = draw(sizes)
    if draw(st.booleans()):
        return draw(arrays(np.float32, size, elements=st.floats(0, largest, width=32)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return np.float32(largest * 2.0 ** rng.uniform(-24, 0, size))


# What is lost on the way through float32, in linear light. An encoded value in [0.5, 1] is rounded by at most 2**-25,
# and the sRGB curve back has a slope of at most 2.4 / 1.055 < 2.28. The curve's two pieces miss each other by 2.9e-8
# at 0.0031308, where the slope is 1 / 12.92: 2.3e-9 < 0.08 * 2**-25 more.
ROUNDING = 2.4 * 2.0**-25


@quick
@given(images(1.0))
def test_the_srgb_curve_is_that_of_colour_science(image):
    """Bit for bit, there and back: the library is the oracle of our two formulas."""
    pytest.importorskip("colour", reason="colour-science is not installed")
    from colour.models import eotf_inverse_sRGB, eotf_sRGB

    image = np.minimum(image, 1)
    srgb = transfer("srgb")
    np.testing.assert_array_equal(srgb.encode(image), eotf_inverse_sRGB(image.astype(float)).astype(np.float32))
    np.testing.assert_array_equal(srgb.decode(image), eotf_sRGB(image.astype(float)).astype(np.float32))


def test_known_values_of_the_srgb_curve():
    """IEC 61966-2-1, worked by hand: the linear piece, mid grey, both ends, and what lies outside."""
    linear = np.float32([[[0, 0.001, 0.0031308]], [[0.18, 0.5, 1]], [[-1, 2, 65504]]])
    expected = [[[0, 0.01292, 0.0404499]], [[0.4613561, 0.7353570, 1]], [[0, 1, 1]]]
    assert np.abs(transfer("srgb").encode(linear) - expected).max() < 1e-7  # the digits given


@quick
@given(name=names, color=arrays(np.float32, sizes, elements=st.floats(width=32)))
def test_anything_a_renderer_gives_becomes_finite_and_within_range(name, color):
    """NaN, infinities and negative light never reach the network or a picture."""
    for image in (transfer(name).encode(color), transfer(name).display(color)):
        assert image.dtype == np.float32
        assert image.shape == color.shape
        assert image.flags.c_contiguous
        assert ((image >= 0) & (image <= 1)).all()


@quick
@given(image=images(1.0))
def test_none_leaves_a_displayed_image_as_it_is(image):
    """Bit for bit, both ways."""
    none = transfer("none")
    assert np.array_equal(none.encode(image), image)
    assert np.array_equal(none.decode(image), image)


@quick
@example(color=np.full((1, 1, 3), 0.0031308, np.float32))
@given(color=images(1.0))
def test_srgb_round_trip(color):
    """Light in [0, 1] comes back."""
    back = transfer("srgb").decode(transfer("srgb").encode(color))
    assert np.abs(back.astype(np.float64) - color).max() <= ROUNDING + 2.0**-25  # and the result's own rounding


@pytest.mark.parametrize("name", TRANSFERS)
def test_every_8_bit_level_survives(name):
    """A PNG's 256 levels, taken to light and back, are the same 256 levels."""
    levels = np.arange(256)
    image = np.repeat(np.float32(levels / 255)[None, :, None], 3, axis=-1)
    back = transfer(name).encode(transfer(name).decode(image))
    assert np.rint(back[0] * 255).tolist() == np.stack([levels] * 3, axis=-1).tolist()


def test_blocks_leave_no_seam():
    """An image larger than a block is the same as its rows alone."""
    rng = np.random.default_rng(0)
    color = rng.random((3, BLOCK // 2 + 1, 3), dtype=np.float32) * 4
    srgb = transfer("srgb")
    rows = [srgb.encode(color[i : i + 1]) for i in range(3)]
    assert np.array_equal(srgb.encode(color), np.concatenate(rows))


def test_mistakes_are_named():
    """A wrong name, a wrong shape, and a network that gives NaN."""
    with pytest.raises(InputError, match="expected one of none, srgb, got 'sRGB'"):
        transfer("sRGB")
    with pytest.raises(ArrayError, match=r"color: expected shape \(any, any, 3\), got \(2, 2\)"):
        transfer("none").encode(np.zeros((2, 2), np.float32))
    with pytest.raises(ArrayError, match=r"image: 1 non-finite values, first at index \(0, 0, 1\)"):
        transfer("srgb").decode(np.float32([[[0, np.nan, 0]]]))
