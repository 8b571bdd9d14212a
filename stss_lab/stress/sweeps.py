# SPDX-License-Identifier: MIT
"""How a stage's error grows with the magnitude of its inputs and weights, the size of the frame and depth; and what it consists of."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from conformance.protocol.port import Arrays
from conformance.protocol.stages import reference
from conformance.tolerance import BOUNDS
from stss_lab.stress.engines import IMAGE, NETWORK, features_of
from stss_lab.stress.inputs import (
    exact,
    frame_noise,
    image_noise,
    permuted,
    scaled,
    scaled_weights,
    stage_inputs,
    transposed,
    transposed_arrays,
)
from stss_lab.stress.monte_carlo import (
    NamesUsed,
    StochasticRounding,
    Trace,
    Where,
    digits_of,
    samples,
    significant_digits,
    watched,
)
from stss_lab.stress.table import Cell, StressPlan, StressTable, in_units, relative_error, short
from stss_ref.arrays import Array
from stss_ref.decoder import decoder
from stss_ref.encoder import encoder
from stss_ref.erm import erm
from stss_ref.history import history_embedding
from stss_ref.weights import Weights, astype

MAGNITUDES = (1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6)
WEIGHT_SCALES = (1 / 16, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 16.0)
IN_UNITS = "largest error / largest truth, in units of rounding"

Point = tuple[str, Arrays, Weights]
"""A stage, its inputs and weights."""


def _errors(plan: StressPlan, points: Sequence[Point]) -> dict[tuple[str, str], float]:
    """(stage, engine) -> error in units of rounding."""
    found: dict[tuple[str, str], float] = {}
    for stage, inputs, weights in points:
        truth = reference(stage, exact(inputs), weights)
        for engine in plan.engines:
            if stage in engine.stages():
                error = relative_error(engine.run(stage, inputs, weights), truth)
                found[stage, engine.name] = in_units(error, engine)
    return found


def _sweep(
    plan: StressPlan, key: str, title: str, axis: Sequence[float], points: Callable[[int, float], Iterator[Point]]
) -> StressTable:
    """A table with a column for each number of ``axis``: the worst error of ``points(seed, number)`` over all seeds."""
    worst: dict[tuple[str, str], list[float]] = defaultdict(lambda: [0.0] * len(axis))
    for seed in range(plan.seeds):
        for i, number in enumerate(axis):
            for row, error in _errors(plan, list(points(seed, number))).items():
                worst[row][i] = max(worst[row][i], error)
    headings = tuple(f"{number:g}" if 0.01 <= number < 1e4 else short(number) for number in axis)
    rows = [(*row, *errors) for row, errors in worst.items()]
    rows.sort(key=lambda row: (*NETWORK, *IMAGE).index(row[0]))
    return StressTable(key, f"{title}: {IN_UNITS}", ("stage", "", *headings), tuple(rows), tuple(axis))


def magnitude(plan: StressPlan) -> StressTable:
    """Inputs 1e-6 to 1e6 times as large as they should be."""
    made = [stage_inputs(s, *plan.size, plan.weights_of(s)) | image_noise(s, *plan.size) for s in range(plan.seeds)]
    weights = [plan.weights_of(s) for s in range(plan.seeds)]

    def points(seed: int, by: float) -> Iterator[Point]:
        for stage, inputs in made[seed].items():
            yield stage, scaled(stage, inputs, by), weights[seed]

    return _sweep(plan, "magnitude", "Inputs times", MAGNITUDES, points)


def weight_scale(plan: StressPlan) -> StressTable:
    """All weights and biases, scaled up or down."""

    def points(seed: int, by: float) -> Iterator[Point]:
        weights = scaled_weights(plan.weights_of(seed), by)
        for stage, inputs in stage_inputs(seed, *plan.size, weights).items():
            yield stage, inputs, weights

    return _sweep(plan, "weights", "Weights times", WEIGHT_SCALES, points)


def size(plan: StressPlan) -> StressTable:
    """Square frames of several sizes."""

    def points(seed: int, side: float) -> Iterator[Point]:
        weights = plan.weights_of(seed)
        for stage, inputs in stage_inputs(seed, int(side), int(side), weights).items():
            yield stage, inputs, weights

    return _sweep(plan, "size", "Frames of so many pixels each way", tuple(map(float, plan.sizes)), points)


FEATURES = {"x1": 2, "x2": 5, "x3": 8, "x4": 11, "feature": 10, "reshaded": 14, "image": 21}
"""Features on the way to the image -> convolutions on the longest way to them."""


def depth(plan: StressPlan) -> StressTable:
    """The error of every feature on the way to the image, including the errors before it."""
    worst: dict[str, list[float]] = {name: [0.0] * (len(plan.engines) + 1) for name in FEATURES}
    for seed in range(plan.seeds):
        inputs, weights = frame_noise(seed, *plan.size), plan.weights_of(seed)
        truth = features_of(exact(inputs), weights)
        for i, engine in enumerate(plan.engines):
            got = engine.features(inputs, weights)
            for name, errors in worst.items():
                error = relative_error({name: got[name]}, {name: truth[name]})
                errors[i] = max(errors[i], in_units(error, engine))
        for name, runs in _feature_runs(inputs, weights, plan.runs).items():
            spread = float(runs.std(axis=0, ddof=1).max()) / float(np.abs(truth[name]).max()) * 2**24
            worst[name][-1] = max(worst[name][-1], spread)
    columns = ("", "layers deep", *(a.name for a in plan.engines), "sigma, Monte Carlo 24 bits")
    rows = tuple((name, FEATURES[name], *errors) for name, errors in worst.items())
    return StressTable("depth", f"Features of the network: {IN_UNITS}", columns, rows)


def _feature_runs(inputs: Arrays, weights: Weights, count: int) -> dict[str, Array]:
    runs = [features_of(watched(inputs, StochasticRounding(24, i)), weights) for i in range(count)]
    return {name: np.stack([run[name] for run in runs]) for name in FEATURES}


def layers(plan: StressPlan) -> StressTable:
    """The error of each convolution's input, reference in float32: how it grows from layer to layer."""
    worst: dict[str, float] = defaultdict(float)
    for seed in range(plan.seeds):
        inputs = frame_noise(seed, *plan.size)
        truths, got = (_read(inputs, plan.weights_of(seed), dtype) for dtype in ("float64", "float32"))
        for name, truth in truths.items():
            error = float(np.abs(got[name] - truth).max()) / float(np.abs(truth).max())
            worst[name] = max(worst[name], error * 2**24)
    title = f"What each convolution reads, reference in float32: {IN_UNITS}"
    return StressTable("layers", title, ("layer", "error of its input"), tuple(worst.items()))


def _read(inputs: Arrays, weights: Weights, dtype: str) -> dict[str, Array]:
    """Layer -> its input in the last of its runs, and the image; computed in ``dtype``."""
    trace, names = Trace(), NamesUsed(astype(weights, dtype))
    x: dict[str, Any] = watched(inputs, trace, dtype)
    x1, x2, x3, x4 = encoder(x["color"], x["gbuffer"], x["mask"], names)
    reshaded = erm(x4, x["gbuffer"], x["mask"], names)
    of_erm = len(trace.read) - 2  # the last two are the attention's keys and values, not inputs of a convolution
    del trace.read[of_erm:]
    image = decoder(reshaded, history_embedding(x["history"], names), x1, x2, x3, x["color"], names)
    readers = [name.removesuffix(".weight") for name in names.asked if name.endswith(".weight")]
    found = {n.removesuffix(".conv_feature"): a for n, a in zip(readers, trace.read, strict=True) if "conv_mask" not in n}
    return found | {"image": np.asarray(image)}


def monte_carlo(plan: StressPlan) -> StressTable:
    """The digits that survive, by Monte Carlo arithmetic and as measured."""
    found: dict[tuple[str, str], list[list[Array]]] = defaultdict(list)
    kinds: tuple[tuple[str, int, Where], ...] = (
        ("Monte Carlo, 24 bits", 24, "operations"),
        ("Monte Carlo, 11 bits stored", 11, "layers"),
        ("Monte Carlo, 11 bits", 11, "operations"),
    )
    for seed in range(plan.seeds):
        weights = plan.weights_of(seed)
        for stage, inputs in (stage_inputs(seed, *plan.size, weights) | _warp_only(seed, plan)).items():
            truth = reference(stage, exact(inputs), weights)
            for name, bits, where in kinds if stage in NETWORK else kinds[:1]:
                runs = samples(stage, inputs, weights, _dice(bits, where, seed), plan.runs)
                digits = {n: significant_digits(runs[n], bits) for n in truth}
                found[stage, name].append(_where_not_zero(digits, truth))
            for engine in plan.engines:
                if stage in engine.stages():
                    bits, got = 24 if engine.dtype == "float32" else 11, engine.run(stage, inputs, weights)
                    digits = {n: digits_of(got[n] - truth[n], truth[n], bits) for n in truth}
                    found[stage, engine.name].append(_where_not_zero(digits, truth))
    rows: list[tuple[Cell, ...]] = []
    for (stage, name), parts in sorted(found.items(), key=lambda row: (*NETWORK, *IMAGE).index(row[0][0])):
        digits = np.concatenate([array for part in parts for array in part])
        rows.append((stage, name, *(float(q) for q in np.percentile(digits, (50, 1)))))
    title = "Significant decimal digits of an output's numbers (float32 has 7.2, half 3.3)"
    return StressTable("monte_carlo", title, ("stage", "", "median", "worst 1 %"), tuple(rows))


def _warp_only(seed: int, plan: StressPlan) -> dict[str, dict[str, Any]]:
    return {"warp": image_noise(seed, *plan.size)["warp"]}


def _dice(bits: int, where: Where, seed: int) -> Callable[[int], StochasticRounding]:
    return lambda i: StochasticRounding(bits, 1000 * seed + i, where)


def _where_not_zero(digits: dict[str, Array], truth: Arrays) -> list[Array]:
    """The digits of numbers that are not 0 (ReLU makes many of them, without any error), masks left out."""
    return [digits[n][truth[n] != 0] for n in truth if truth[n].dtype.kind == "f"]


def order(plan: StressPlan) -> StressTable:
    """The same sums in other orders: the part of the error that is due to the order."""
    found: dict[tuple[str, str], list[float]] = defaultdict(lambda: [0.0, 0.0, 0.0])
    for seed in range(plan.seeds):
        weights = plan.weights_of(seed)
        made = stage_inputs(seed, *plan.size, weights)
        runs: dict[tuple[str, str], list[Arrays]] = defaultdict(list)
        for i in range(plan.runs):
            # Orders in the outer loop, stages in the inner one: a backend prepares once for each set of weights.
            turned, other = i % 2 == 1, weights if i == 0 else permuted(weights, i)
            other = transposed(other) if turned else other
            for stage, inputs in made.items():
                given = transposed_arrays(inputs) if turned else inputs
                for engine in plan.engines:
                    got = engine.run(stage, given, other)
                    runs[stage, engine.name].append(transposed_arrays(got) if turned else got)
        for (stage, name), group in runs.items():
            errors = _order_errors(group, reference(stage, exact(made[stage]), weights))
            row = found[stage, name]
            row[:] = [max(old, in_units(new, plan.engine(name))) for old, new in zip(row, errors, strict=True)]
    columns = ("stage", "", "error", "spread over orders", "error of their mean")
    title = f"{plan.runs} orders of summation: {IN_UNITS}"
    return StressTable("order", title, columns, tuple((*row, *errors) for row, errors in found.items()))


def _order_errors(runs: Sequence[Arrays], truth: Arrays) -> tuple[float, float, float]:
    stacks = {name: np.stack([run[name].astype(np.float64) for run in runs]) for name in truth}
    ranges = {name: np.ptp(stack, axis=0) + truth[name] for name, stack in stacks.items()}
    means = {name: stack.mean(axis=0) for name, stack in stacks.items()}
    return relative_error(runs[0], truth), relative_error(ranges, truth), relative_error(means, truth)


def bounds(plan: StressPlan) -> StressTable:
    """The network's absolute error at its ordinary size, beside the bound that it must meet."""
    rows: list[tuple[Cell, ...]] = []
    for engine in plan.engines:
        errors: list[float] = []
        for seed in range(plan.seeds):
            inputs, weights = frame_noise(seed, *plan.size), plan.weights_of(seed)
            truth = reference("network", exact(inputs), weights)["image"]
            errors.append(float(np.abs(engine.run("network", inputs, weights)["image"] - truth).max()))
        asked = {"ref": "float32", "cl": "cl.float32", "cl direct": "cl.float32-direct", "cl half": "cl.half"}[engine.name]
        rows.append((engine.name, float(np.median(errors)), max(errors), BOUNDS[f"network.{asked}"].floor))
    columns = ("", "median seed", "worst seed", "asked")
    return StressTable("bounds", "Image of the network: largest absolute error", columns, tuple(rows))
