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
COLOR, STENCIL = arrays(float, (*SIZE, 3), elements=UNIT), arrays(float, SIZE, elements=st.integers(0, 2))
SIXTEENTHS = st.integers(-48, 48).map(lambda n: n / 16)  # a sum with a column is exact
FRAME = st.tuples(COLOR, arrays(float, (*SIZE, 2), elements=SIXTEENTHS), STENCIL)


def place(first, stencil, frames, y, x, sy, sx):
    """The luma of a place of pixel (y, x), of every sample of every frame."""
    total, value = OWN, OWN * (first[y, x] @ LUMA)
    for color, motion, numbers in frames:
        to_x, to_y = x + motion[y, x, 0], y + motion[y, x, 1]
        for v, u in np.ndindex(*SIZE) if 0 <= to_x <= SIZE[1] - 1 and 0 <= to_y <= SIZE[0] - 1 else ():
            dx, dy = to_x + sx - u, to_y + sy - v
            weight = max(0, 1 - 2 * abs(dx)) * max(0, 1 - 2 * abs(dy)) * (numbers[v, u] == stencil[y, x])
            total, value = total + weight, value + weight * (color[v, u] @ LUMA)
    return value / total


@settings(max_examples=40)
@given(first=COLOR, stencil=STENCIL, frames=st.lists(FRAME, max_size=3))
def test_detail_is_its_definition_sample_by_sample(first, stencil, frames):
    want = np.empty((*SIZE, 3))
    for y, x in np.ndindex(*SIZE):
        a, b, c, d = (place(first, stencil, frames, y, x, sy, sx) for sy in (-0.25, 0.25) for sx in (-0.25, 0.25))
        want[y, x] = (b - a + d - c) / 2, (c - a + d - b) / 2, (a + b + c + d) / 4 - first[y, x] @ LUMA
    got = detail(first, stencil, frames)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)
    assert np.abs(got).max() <= 1 + 1e-12
    mirrored = [(c[:, ::-1], m[:, ::-1] * (-1, 1), n[:, ::-1]) for c, m, n in frames]
    np.testing.assert_allclose(detail(first[:, ::-1], stencil[:, ::-1], mirrored), got[:, ::-1] * (-1, 1, 1), rtol=0, atol=1e-12)


def test_detail_by_hand():
    """A sample a quarter of a pixel to the left shows the left places alone; a frame at rest, and no frame, show nothing within a pixel."""
    first, white = np.zeros((*SIZE, 3)), np.ones((*SIZE, 3))
    motion, same = np.zeros((*SIZE, 2)), np.zeros(SIZE)
    assert not detail(first, same, []).any()
    np.testing.assert_array_equal(detail(first, same, [(white, motion, same)])[..., :2], 0)
    motion[..., 0] = 0.25
    left = 0.5 / (OWN + 0.5)  # at the left places it weighs t(0) t(1/4), at the right ones t(1/2) = 0
    np.testing.assert_allclose(detail(first, same, [(white, motion, same)])[1, 1], (-left, 0, left / 2), rtol=1e-12)


@given(first=COLOR, frame=FRAME)
def test_other_objects_and_what_is_off_screen_are_not_read(first, frame):
    color, motion, stencil = frame
    motion[0, 0] = np.nan
    assert not detail(first, stencil, [(color, motion, stencil + 3)]).any()
    assert not detail(first, stencil, [(color, motion, stencil)])[0, 0].any()
