# SPDX-License-Identifier: MIT
"""Right answers where rounding decides: all of them, and no others."""

from itertools import product

import hypothesis
import numpy as np
from hypothesis import strategies as st

from conformance.answers.expected import largest
from conformance.answers.motion_chain import expect_motion_chain
from conformance.answers.occlusion_warp import expect_occlusion_warp
from conformance.answers.port_arithmetic import Arithmetic
from stss_ref.motion_chain import motion_chain
from stss_ref.occlusion_warp import look_up, splat

HALF = Arithmetic("float16")
SIZE = HEIGHT, WIDTH = 2, 3


def ways(y, x, motion, off):
    """Where a pixel's motion may lead, as (row, column)."""
    if not np.isfinite(motion).all():
        return {(y, x)}
    (column, row) = ({p + int(np.floor(m + e)) for e in (-o, 0, o)} for p, m, o in zip((x, y), motion, off, strict=True))
    return set(product(row, column))


def answers(motion, depth, off):
    """For each pixel the motions that it reads if each pixel writes where one of its ways leads, and reads where one does, for all
    choices of ways, each tried by itself."""
    off = off + np.where((motion != 0) & (np.abs(motion) < HALF.tiny), HALF.tiny, 0)
    leads = {p: ways(*p, motion[p], off[p]) for p in np.ndindex(SIZE)}
    found = {p: set() for p in leads}
    # The nearest first, and of equals the first in raster order.
    writers = sorted((p for p in leads if np.isfinite(motion[p]).all() and depth[p] < 10), key=lambda p: depth[p])
    for chosen in product(*(leads[p] for p in writers)):
        earlier = {}
        for pixel, (row, column) in zip(writers, chosen, strict=True):
            for j, i in product((0, 1), (0, 1)):
                earlier.setdefault((row + j, column + i), tuple(motion[pixel]))
        for pixel, places in leads.items():
            for row, column in places:
                place = min(max(row, 0), HEIGHT - 1), min(max(column, 0), WIDTH - 1)
                found[pixel].add(earlier.get(place, (0.0, 0.0)))
    return found


@hypothesis.given(seed=st.integers(0, 2**32 - 1))
def test_any_way_of_each_pixel_is_right(seed):
    """A motion too small for half leads to either pixel, one that is off by over a pixel to three."""
    random = np.random.default_rng(seed)
    motion = random.choice([0.0, 0.25, 0.5, -1.0, 2.0], (*SIZE, 2))
    off = np.zeros(motion.shape)
    small, far, broken = random.choice(HEIGHT * WIDTH, (3, 2), replace=False)
    motion.reshape(-1, 2)[small] = random.choice([1e-5, -1e-5, 0.75], (2, 2))
    off.reshape(-1, 2)[far[0]] = random.choice([0.25, 0.5, 1.25], 2)
    motion.reshape(-1, 2)[broken[0]] = random.choice([np.nan, 1.0], 2)
    depth = random.choice([0.0, -0.0, 0.5, 10.0], SIZE)
    inputs = {
        "motion": motion,
        "depth": depth,
        "color": np.zeros((*SIZE, 3)),
        "warped": np.zeros((*SIZE, 3)),
        "valid": np.ones(SIZE),
    }

    expected = expect_occlusion_warp(inputs, HALF, off=off)["occlusion_motion"]
    found = {p: {tuple(each[p]) for each in (expected.want, *expected.others)} for p in np.ndindex(SIZE)}
    assert found == answers(motion, depth, off)
    np.testing.assert_array_equal(expected.want, look_up(splat(motion, depth), motion))


def test_of_lengths_beyond_float32_any_is_the_longest():
    """Float32 takes the first of them, and float64 the one that is not finite."""
    motions = np.ones((2, 2, 2, 2))
    motions[0] = 0.25
    motions[1, 0] = [1e30, 0], [np.nan, 1]
    right = expect_motion_chain({"motions": motions}, Arithmetic("float32"))["motion"]
    for dtype in (np.float32, np.float64):
        got = motion_chain(motions.astype(dtype))
        assert largest(right.closer(got), got) <= 1
    none_of_them = np.full((2, 2, 2), 1.25, np.float32)
    assert largest(right.closer(none_of_them), none_of_them) > 1
