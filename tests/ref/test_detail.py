# SPDX-License-Identifier: MIT
"""The second colour "detail" against its definition, sample by sample, and by its properties."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from stss_ref.detail import LUMA, OWN, detail

SIZE = 4, 5
UNIT = st.floats(0, 1, width=32)
COLOR, MASK = arrays(float, (*SIZE, 3), elements=UNIT), arrays(bool, SIZE)
FRAME = st.tuples(COLOR, arrays(float, (*SIZE, 2), elements=st.floats(-3, 3)), MASK)


def inside(motion, valid):
    """``valid`` as it can be: nowhere where the motion leads outside."""
    y, x = np.indices(SIZE)
    x, y = x + motion[..., 0], y + motion[..., 1]
    return valid & (x >= 0) & (y >= 0) & (x <= SIZE[1] - 1) & (y <= SIZE[0] - 1)


def place(first, frames, y, x, sy, sx):
    """The luma of a place of pixel (y, x), of every sample of every frame."""
    total, value = OWN, OWN * (first[y, x] @ LUMA)
    for color, motion, valid in frames:
        for v, u in np.ndindex(*SIZE) if valid[y, x] else ():
            dx, dy = x + sx + motion[y, x, 0] - u, y + sy + motion[y, x, 1] - v
            weight = max(0, 1 - 2 * abs(dx)) * max(0, 1 - 2 * abs(dy))
            total, value = total + weight, value + weight * (color[v, u] @ LUMA)
    return value / total


@settings(max_examples=40)
@given(first=COLOR, frames=st.lists(FRAME, max_size=3))
def test_detail_is_its_definition_sample_by_sample(first, frames):
    frames = [(color, motion, inside(motion, valid)) for color, motion, valid in frames]
    want = np.empty((*SIZE, 3))
    for y, x in np.ndindex(*SIZE):
        a, b, c, d = (place(first, frames, y, x, sy, sx) for sy in (-0.25, 0.25) for sx in (-0.25, 0.25))
        want[y, x] = (b - a + d - c) / 2, (c - a + d - b) / 2, (a + b + c + d) / 4 - first[y, x] @ LUMA
    got = detail(first, frames)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)
    assert np.abs(got).max() <= 1 + 1e-12
    mirrored = [(c[:, ::-1], m[:, ::-1] * (-1, 1), v[:, ::-1]) for c, m, v in frames]
    np.testing.assert_allclose(detail(first[:, ::-1], mirrored), got[:, ::-1] * (-1, 1, 1), rtol=0, atol=1e-12)


def test_detail_by_hand():
    """A sample a quarter of a pixel to the left shows the left places alone; a frame at rest, and no frame, show nothing within a pixel."""
    first, white = np.zeros((*SIZE, 3)), np.ones((*SIZE, 3))
    motion, everywhere = np.zeros((*SIZE, 2)), np.ones(SIZE, bool)
    assert not detail(first, []).any()
    np.testing.assert_array_equal(detail(first, [(white, motion, everywhere)])[..., :2], 0)
    motion[..., 0] = 0.25
    left = 0.5 / (OWN + 0.5)  # at the left places it weighs t(0) t(1/4), at the right ones t(1/2) = 0
    np.testing.assert_allclose(
        detail(first, [(white, motion, inside(motion, everywhere))])[1, 1], (-left, 0, left / 2), rtol=1e-12
    )


@given(first=COLOR, frame=FRAME)
def test_what_is_not_valid_is_not_read(first, frame):
    color, motion, _ = frame
    motion[0, 0] = np.nan
    assert not detail(first, [(color, motion, np.zeros(SIZE, bool))]).any()
