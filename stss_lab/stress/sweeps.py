# SPDX-License-Identifier: MIT
"""How a stage's error grows with the magnitude of its inputs and weights, the size of the frame and depth."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from conformance.protocol.port import Arrays
from conformance.protocol.stages import reference
from conformance.tolerance import BOUNDS
from stss_lab.stress.engines import IMAGE, NETWORK, features_of
from stss_lab.stress.inputs import (
    exact,
    frame_noise,
    image_noise,
    scale,
    scale_weights,
    stage_inputs,
)
from stss_lab.stress.table import Cell, StressPlan, StressTable, in_units, relative_error, short
from stss_ref.weights import Weights

MAGNITUDES = (1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6)
WEIGHT_SCALES = (1 / 16, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 16.0)
IN_UNITS = "largest error / largest truth, in units of rounding"

Point = tuple[str, Arrays, Weights]
"""A stage, its inputs and weights."""


def _errors(plan: StressPlan, points: Sequence[Point]) -> dict[tuple[str, str], float]:
    """(stage, engine) -> error in units of rounding."""
    errors: dict[tuple[str, str], float] = {}
    for stage, inputs, weights in points:
        truth = reference(stage, exact(inputs), weights)
        for engine in plan.engines:
            if stage in engine.stages():
                error = relative_error(engine.run(stage, inputs, weights), truth)
                errors[stage, engine.name] = in_units(error, engine)
    return errors


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
    return StressTable(key, f"{title}: {IN_UNITS}", ("stage", "", *headings), tuple(rows))


def magnitude(plan: StressPlan) -> StressTable:
    """Inputs 1e-6 to 1e6 times as large as usual."""
    inputs_of = [stage_inputs(s, *plan.size, plan.weights_of(s)) | image_noise(s, *plan.size) for s in range(plan.seeds)]
    weights = [plan.weights_of(s) for s in range(plan.seeds)]

    def points(seed: int, by: float) -> Iterator[Point]:
        for stage, inputs in inputs_of[seed].items():
            yield stage, scale(stage, inputs, by), weights[seed]

    return _sweep(plan, "magnitude", "Inputs times", MAGNITUDES, points)


def weight_scale(plan: StressPlan) -> StressTable:
    """All weights and biases, scaled up or down."""

    def points(seed: int, by: float) -> Iterator[Point]:
        weights = scale_weights(plan.weights_of(seed), by)
        for stage, inputs in stage_inputs(seed, *plan.size, weights).items():
            yield stage, inputs, weights

    return _sweep(plan, "weights", "Weights times", WEIGHT_SCALES, points)


def size(plan: StressPlan) -> StressTable:
    """Square frames of several sizes."""

    def points(seed: int, side: float) -> Iterator[Point]:
        weights = plan.weights_of(seed)
        for stage, inputs in stage_inputs(seed, int(side), int(side), weights).items():
            yield stage, inputs, weights

    return _sweep(plan, "size", "Square frames, by side in pixels", tuple(map(float, plan.sizes)), points)


FEATURES = {"x1": 2, "x2": 5, "x3": 8, "x4": 11, "feature": 10, "reshaded": 14, "image": 21}
"""Features on the way to the image -> convolutions on the longest way to them."""


def depth(plan: StressPlan) -> StressTable:
    """The error of every feature on the way to the image, including the errors before it."""
    worst: dict[str, list[float]] = {name: [0.0] * len(plan.engines) for name in FEATURES}
    for seed in range(plan.seeds):
        inputs, weights = frame_noise(seed, *plan.size), plan.weights_of(seed)
        truth = features_of(exact(inputs), weights)
        for i, engine in enumerate(plan.engines):
            got = engine.features(inputs, weights)
            for name, errors in worst.items():
                error = relative_error({name: got[name]}, {name: truth[name]})
                errors[i] = max(errors[i], in_units(error, engine))
    columns = ("", "layers deep", *(a.name for a in plan.engines))
    rows = tuple((name, FEATURES[name], *errors) for name, errors in worst.items())
    return StressTable("depth", f"Features of the network: {IN_UNITS}", columns, rows)


def bounds(plan: StressPlan) -> StressTable:
    """The network's absolute error at its ordinary size, beside the bound that it must meet."""
    rows: list[tuple[Cell, ...]] = []
    for engine in plan.engines:
        errors: list[float] = []
        for seed in range(plan.seeds):
            inputs, weights = frame_noise(seed, *plan.size), plan.weights_of(seed)
            truth = reference("network", exact(inputs), weights)["image"]
            errors.append(float(np.abs(engine.run("network", inputs, weights)["image"] - truth).max()))
        row = {
            "ref": "float32",
            "cl": "cl.float32",
            "cl direct": "cl.float32-direct",
            "cl half": "cl.half",
            "cl bfloat16": "cl.bfloat16",
        }[engine.name]
        rows.append((engine.name, float(np.median(errors)), max(errors), BOUNDS[f"network.{row}"].floor))
    columns = ("", "median seed", "worst seed", "bound")
    return StressTable("bounds", "Image of the network: largest absolute error", columns, tuple(rows))


def overflow(plan: StressPlan) -> StressTable:
    """The end of half's range: inputs so large that activations exceed 65504."""
    rows: list[tuple[Cell, ...]] = []
    for by in (1.0, 1e2, 1e3, 1e4, 1e5, 1e6):
        largest, errors = 0.0, [0.0] * len(plan.engines)
        for seed in range(plan.seeds):
            inputs, weights = scale("network", frame_noise(seed, *plan.size), by), plan.weights_of(seed)
            features = features_of(exact(inputs), weights)
            truth = {"image": features["image"]}
            largest = max(largest, *(float(np.abs(array).max()) for array in features.values()))
            now = [relative_error(a.run("network", inputs, weights), truth) for a in plan.engines]
            errors = [max(pair) for pair in zip(errors, now, strict=True)]
        rows.append((short(by), largest, *errors))
    columns = ("inputs times", "largest feature", *(a.name for a in plan.engines))
    return StressTable("overflow", "Image of the network: largest error / largest truth", columns, tuple(rows))
