# SPDX-License-Identifier: MIT
"""Inputs made to lose digits in the network: attention near its clamp, tiny and huge keys, one huge pixel, the end of half's range."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from conformance.protocol.stages import reference
from stss_lab.stress.engines import features_of
from stss_lab.stress.inputs import exact, frame_noise, scaled, scaled_weights, stage_inputs
from stss_lab.stress.table import Cell, StressPlan, StressTable, in_units, relative_error, short
from stss_ref.arrays import Array
from stss_ref.conv import conv_chain
from stss_ref.erm import WINDOW, attend, normalise
from stss_ref.resample import downsample_8
from stss_ref.weights import Weights, astype

TILES = 16
"""Number of attention windows in each direction."""
SUMS = (1.0, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
KEY_POWERS = (-60, -40, -30, -20, -10, 0, 10, 20, 40, 62, 70)
HUGE = (1.0, 1e2, 1e4, 1e6)
"""Values of one pixel among others of up to 1."""
WINDOW_OF_X1 = 2
"""Pixels from an output of x1 to the farthest input it depends on."""
TILES_OF_X1 = 10
"""The same with whole Winograd tiles of two layers: 5 each."""


def attention(plan: StressPlan) -> StressTable:
    """Sums of attention weights near the clamp: keys nearly orthogonal to the query, the centre masked."""
    rows: list[tuple[Cell, ...]] = []
    for target in SUMS:
        found = np.array([list(_attention_errors(seed, target)) for seed in range(plan.seeds)])
        rows.append((short(target), float(np.median(found[:, 0])), *(float(x) for x in found[:, 1:].max(axis=0))))
    columns = ("sum aimed at", "sum", "its error, float32", "light, float32", "half storage", "half, but keys float32")
    return StressTable("attention", "Error of the reshaded light over the largest light", columns, tuple(rows))


def _attention_errors(seed: int, target: float) -> Iterator[float]:
    raw, value, mask = _windows(seed, target)
    truth, total = _centres(normalise(raw.astype(np.float64)), mask, value.astype(np.float64))
    largest = float(np.abs(value).max())
    key = normalise(raw)
    half_key, half_value = (a.astype(np.float16).astype(np.float32) for a in (key, value))
    single, single_total = _centres(key, mask, value)
    yield float(np.median(total))
    yield float(np.abs(single_total - total).max())
    yield float(np.abs(single - truth).max()) / largest
    for keys in (half_key, key):
        yield float(np.abs(_centres(keys, mask, half_value)[0] - truth).max()) / largest


def _windows(seed: int, target: float) -> tuple[Array, Array, Array]:
    """Keys before they are normalised, light, and the mask, all float32, of windows side by side."""
    random = np.random.default_rng(seed)
    side, middle = TILES * WINDOW, WINDOW // 2
    key = random.standard_normal((TILES, WINDOW, TILES, WINDOW, 32))
    query = normalise(key[:, middle, :, middle])[:, None, :, None]
    key[:, middle, :, middle] = 1  # anything but the query: it is put there at the end
    key = normalise(key - (key * query).sum(axis=-1, keepdims=True) * query)
    cosine = target / (WINDOW * WINDOW - 1) * random.uniform(0, 2, (*key.shape[:-1], 1))
    key = (key * np.sqrt(1 - cosine * cosine) + cosine * query) * random.uniform(0.5, 2, cosine.shape)
    key[:, middle, :, middle] = query[:, 0, :, 0]
    mask = np.ones((TILES, WINDOW, TILES, WINDOW, 1))
    mask[:, middle, :, middle] = 0
    mask = mask.reshape(side, side, 1)
    value = random.standard_normal((side, side, 64)) * mask
    return key.reshape(side, side, 32).astype(np.float32), value.astype(np.float32), mask.astype(np.float32)


def _centres(key: Array, mask: Array, value: Array) -> tuple[Array, Array]:
    """The reshaded light and the sum of weights at each window's centre; both float64."""
    mask = mask.astype(key.dtype)
    at = np.s_[WINDOW // 2 :: WINDOW, WINDOW // 2 :: WINDOW]
    # With such a short query every sum falls below the clamp, so that only the clamp divides it.
    tiny = 2.0**-30
    sums = attend(key * key.dtype.type(tiny), key * mask, np.ones_like(mask))[at].astype(np.float64)
    return attend(key, key * mask, value)[at].astype(np.float64), sums * (1e-6 / tiny)


def keys(plan: StressPlan) -> StressTable:
    """Keys 2^-60 to 2^70 times as long: only their direction counts, until a square leaves the arithmetic's range."""
    found: dict[int, list[list[float]]] = {power: [] for power in KEY_POWERS}
    for seed in range(plan.seeds):
        inputs = stage_inputs(seed, *plan.size, plan.weights_of(seed))["erm"]
        unchanged = reference("erm", exact(inputs), plan.weights_of(seed))
        for power, runs in found.items():
            weights = scaled_weights(plan.weights_of(seed), 2.0**power, "KEncoder.4.")
            truth = reference("erm", exact(inputs), weights)
            errors = [in_units(relative_error(a.run("erm", inputs, weights), truth), a) for a in plan.engines]
            runs.append([_key_length(inputs["gbuffer"], weights), *errors, relative_error(truth, unchanged)])
    rows = tuple((f"2^{power}", *(float(x) for x in np.max(runs, axis=0))) for power, runs in found.items())
    columns = ("keys times", "their length", *(a.name for a in plan.engines), "change of the truth")
    title = "Reshaded light: largest error / largest truth, in units of rounding; last: the truth's own relative change"
    return StressTable("keys", title, columns, rows)


def _key_length(gbuffer: Array, weights: Weights) -> float:
    """Median length of the keys before they are normalised."""
    f = downsample_8(gbuffer.astype(np.float64))
    key = conv_chain(f, astype(weights, np.float64), "KEncoder", (1, 1, 1), last_relu=False)
    return float(np.median(np.sqrt((key * key).sum(axis=-1))))


def huge(plan: StressPlan) -> StressTable:
    """One huge pixel: the errors of x1 where x1 does not depend on it, within the reach of Winograd's tiles and beyond."""
    rows: list[tuple[Cell, ...]] = []
    for value in HUGE:
        for engine in plan.engines:
            found = [_around_one(plan, seed, value, engine.name) for seed in range(plan.seeds)]
            rows.append((short(value), engine.name, *(float(x) for x in np.max(found, axis=0))))
    columns = ("pixel", "", f"{WINDOW_OF_X1 + 1} to {TILES_OF_X1} pixels away", "farther")
    title = "x1 beyond the pixel's own window: largest error / largest truth there, in units of rounding"
    return StressTable("huge", title, columns, tuple(rows))


def _around_one(plan: StressPlan, seed: int, value: float, name: str) -> tuple[float, float]:
    engine = plan.engine(name)
    inputs = stage_inputs(seed, *plan.size, plan.weights_of(seed))["encoder"]
    y, x = plan.size[0] // 2 + seed % 4, plan.size[1] // 2 + seed // 4 % 4  # a different place within its tile for each seed
    inputs["color"][y, x] = value
    truth = reference("encoder", exact(inputs), plan.weights_of(seed))["x1"]
    got = engine.run("encoder", inputs, plan.weights_of(seed))["x1"]
    rows, columns = np.indices(plan.size)
    distance = np.maximum(np.abs(rows - y), np.abs(columns - x))
    rings = (distance > WINDOW_OF_X1) & (distance <= TILES_OF_X1), distance > TILES_OF_X1
    near, far = (in_units(relative_error({"x1": got[ring]}, {"x1": truth[ring]}), engine) for ring in rings)
    return near, far


def overflow(plan: StressPlan) -> StressTable:
    """The end of half's range: inputs so large that activations exceed 65504."""
    rows: list[tuple[Cell, ...]] = []
    for by in (1.0, 1e2, 1e3, 1e4, 1e5, 1e6):
        largest, errors = 0.0, [0.0] * len(plan.engines)
        for seed in range(plan.seeds):
            inputs, weights = scaled("network", frame_noise(seed, *plan.size), by), plan.weights_of(seed)
            features = features_of(exact(inputs), weights)
            truth = {"image": features["image"]}
            largest = max(largest, *(float(np.abs(array).max()) for array in features.values()))
            found = [relative_error(a.run("network", inputs, weights), truth) for a in plan.engines]
            errors = [max(pair) for pair in zip(errors, found, strict=True)]
        rows.append((short(by), largest, *errors))
    columns = ("inputs times", "largest feature", *(a.name for a in plan.engines))
    return StressTable("overflow", "Image of the network: largest error / largest truth", columns, tuple(rows))
