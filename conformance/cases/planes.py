# SPDX-License-Identifier: MIT
"""Hypothesis strategies for frames, motion and masks.

Numbers that Hypothesis draws are simple and hardly ever round, so most arrays are filled from a drawn seed. A drawn kind steers them to
the inputs at which ports go wrong.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Size = tuple[int, int]

SEEDS = st.integers(0, 2**32 - 1)
made_once = lru_cache(4096)
"""Keeps the strategy for each size: Hypothesis takes longer to make and to check one than to draw from it."""


@made_once
def sizes(largest: int = 20) -> st.SearchStrategy[Size]:
    """(H, W) from 1 x 1 up, with frames of one row or column, and with every remainder modulo 8."""
    return st.tuples(st.integers(1, largest), st.integers(1, largest))


@made_once
@st.composite
def frames(draw: st.DrawFn, size: Size, channels: int, kind: Literal["any", "flat"] = "any") -> Float64:
    """(H, W, channels) of numbers that float32 has exactly: noise, a flat frame, a ramp, or mostly 0."""
    random = np.random.default_rng(draw(SEEDS))
    filled = kind if kind == "flat" else draw(st.sampled_from(["noise", "flat", "ramp", "sparse"]))
    shape = (*size, channels)
    if filled == "flat":
        values = np.broadcast_to(random.random(channels), shape)
    elif filled == "ramp":
        values = np.linspace(0, 1, int(np.prod(shape))).reshape(shape)
    else:
        values = random.random(shape)
        if filled == "sparse":
            values = values * (random.random(shape) < 0.1)
    return values.astype(np.float32).astype(np.float64)


@made_once
@st.composite
def colors(draw: st.DrawFn, size: Size, channels: int, kind: str = "any") -> Float64:
    """(H, W, channels) colours: in [0, 1], flat, or as HDR and broken renderers give: 0, denormal, negative, 65504 and beyond."""
    random = np.random.default_rng(draw(SEEDS))
    filled = (
        draw(st.sampled_from(["unit", "unit", "flat", "sparse", "high", "negative", "denormal", "mixed"]))
        if kind == "any"
        else kind
    )
    values = random.random((*size, channels))
    if filled == "flat":
        values = np.broadcast_to(values[:1, :1] * draw(st.sampled_from([0.0, 1.0, 1e3])), values.shape)
    elif filled == "sparse":
        values = values * (random.random(values.shape) < 0.1)
    elif filled == "high":
        values = values * draw(st.sampled_from([65504.0, 1e6]))
    elif filled == "bright":
        values = values * 3
    elif filled == "negative":
        values = values - 0.5
    elif filled == "denormal":
        values = values * 1e-39
    elif filled == "mixed":
        values = values * 10.0 ** random.integers(-6, 5, values.shape)
    return values.astype(np.float32).astype(np.float64)


@made_once
@st.composite
def motions(draw: st.DrawFn, size: Size, *, broken: bool = False) -> Float64:
    """(H, W, 2) motion that float32 has exactly: still, whole pixels or nearly, halves, short, as long as the frame, or far outside.

    Args:
        draw: Hypothesis's function.
        size: (H, W).
        broken: some may be NaN or infinite.
    """
    random = np.random.default_rng(draw(SEEDS))
    kind = draw(st.sampled_from(["still", "whole", "half", "short", "long", "far", "tiny", "nearly", "one", "alike", "mixed"]))
    shape = (*size, 2)
    reach = max(size)
    kinds = {
        "still": np.zeros(shape),
        "whole": random.integers(-reach, reach + 1, shape).astype(np.float64),
        "half": random.integers(-2 * reach, 2 * reach + 1, shape) / 2,
        "short": random.uniform(-1.5, 1.5, shape),
        "long": random.uniform(-1.5 * reach, 1.5 * reach, shape),
        "far": random.uniform(-1, 1, shape) * 10.0 ** random.integers(0, 12, shape),
        "tiny": random.uniform(-1, 1, shape) * 10.0 ** random.integers(-12, -3, shape),
        "nearly": random.integers(-reach, reach + 1, shape)
        + random.choice([-1, 1], shape) * 2.0 ** random.integers(-14, -8, shape),
        "one": np.broadcast_to(random.uniform(-2, 2, 2), shape),
        "alike": np.sort(random.choice([0.3, 0.7, -0.3], shape), axis=-1)[..., :: random.choice([-1, 1])],
    }
    if kind == "mixed":
        choice = random.integers(0, len(kinds), size)[..., None]
        motion = np.select([choice == i for i in range(len(kinds))], list(kinds.values()))
    else:
        motion = kinds[kind].copy()
    if broken and draw(st.integers(0, 7)) == 0:
        lost = random.random(size) < 0.2
        motion[lost, random.integers(2, size=lost.sum())] = random.choice([np.nan, np.inf, -np.inf], lost.sum())
    return motion.astype(np.float32).astype(np.float64)


@made_once
@st.composite
def dyadic_motions(draw: st.DrawFn, size: Size, kind: str) -> Float64:
    """(H, W, 2) of ``still``, ``whole``, ``half`` or ``short`` (quarters) motion, whose sums with places are exact in all arithmetics."""
    random = np.random.default_rng(draw(SEEDS))
    reach = min(max(size), 40)
    if kind == "still":
        return np.zeros((*size, 2))
    if kind == "whole":
        return random.integers(-reach, reach + 1, (*size, 2)).astype(np.float64)
    if kind == "half":
        return random.integers(-reach, reach + 1, (*size, 2)) / 2
    return random.integers(-6, 7, (*size, 2)) / 4


@made_once
@st.composite
def masks(draw: st.DrawFn, size: Size) -> NDArray[np.bool_]:
    """(H, W) mask: all 1, all 0, a single 1, a single 0, or random."""
    random = np.random.default_rng(draw(SEEDS))
    kind = draw(st.sampled_from(["all", "none", "one", "but one", "any"]))
    if kind == "any":
        return random.random(size) < 0.5
    mask = np.full(size, kind in ("all", "but one"))
    if kind in ("one", "but one"):
        mask.flat[random.integers(mask.size)] ^= True
    return mask
