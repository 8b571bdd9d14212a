# SPDX-License-Identifier: MIT
"""The network's stages: the error that rounding can cause, found by changing the weights of the float64 reference.

A port's layer, with any order of its sums, equals an exact layer whose weights are each changed by at most gamma_n, relatively
(backward error; Higham, Accuracy and Stability, section 3.1). So the reference runs again with weights that are changed at random by
that much. The root mean square of the changes of its outputs, times the row ``spread``, is the allowed error of a port. It grows with
data, weights and depth exactly as rounding errors do, and needs no constant for any of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.port_arithmetic import Arithmetic
from conformance.protocol.port import Arrays, Outputs
from conformance.protocol.reference_copy import reference_layers
from conformance.protocol.stages import STAGES, check_inputs
from conformance.tolerance import BOUNDS, UNIT
from stss_ref.weights import TENSORS, Tensors, Weights, astype

Errors = tuple[NDArray[Any] | float, NDArray[Any] | float]
"""(H, W, 6) the largest errors of a port's colours: by their own rounding, and by that of the motion that reads them."""
OPEN = 100.0
"""A gate's bias at which its sigmoid is 1."""
TAIL = 4.0
"""The largest of many normal deviations, in rms. If gates nearly close, a few deviations are larger; then these count."""
SAMPLE = 96
"""Rows and columns that give a larger frame's bounds: its numbers have the same distribution everywhere, so one mean square holds."""
SPARSE = {"erm": 3}
"""Factor of that number for a stage with all numbers at 1/8 size, since many of its windows would be cut."""
RUNS = 3
"""Runs with changed weights; every number of every output is a sample."""
MOST_SETS = 16
"""Most sets of weights whose changed forms are kept: one more than the drawn cases have."""
_forms: dict[tuple[Any, ...], tuple[Weights, tuple[Weights, list[Weights], Weights]]] = {}
"""By the identities of a set's arrays, which are kept alive, so that no other array gets their addresses."""


def expect_with_weights(
    stage: str, inputs: dict[str, NDArray[Any]], weights: Weights, arithmetic: Arithmetic, errors: Errors = (0.0, 0.0)
) -> dict[str, Expected]:
    """The right answers and allowed errors of a stage that takes weights.

    Args:
        stage: name of the stage.
        inputs: float64.
        weights: float32.
        arithmetic: of the port.
        errors: of the colours among the inputs.
    """
    return _spread(STAGES[stage].compute, inputs, weights, arithmetic, part_of(stage, inputs), errors)


def expect_layers(stage: str, inputs: dict[str, NDArray[Any]], weights: Weights, arithmetic: Arithmetic) -> dict[str, Expected]:
    """The right answers and allowed errors of a stage's layers (``conformance.protocol.layers``), in the order of computation.

    Arguments as of `expect_with_weights`.
    """
    return _spread(partial(reference_layers, stage), inputs, weights, arithmetic)


def part_of(stage: str, inputs: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The first rows and columns of a frame of more than ``SAMPLE`` times ``SAMPLE`` pixels: enough numbers for a root mean square."""
    specs, side = STAGES[stage].inputs, SAMPLE * SPARSE.get(stage, 1)
    sizes = check_inputs(stage, inputs)
    height, width = sizes["H"], sizes["W"]
    if height * width <= side * side:
        return inputs
    sizes |= {"H": _at_most(side, height, width), "W": _at_most(side, width, height)}
    return {name: array[tuple(slice(n) for n in specs[name].shape(sizes))] for name, array in inputs.items()}


def _at_most(side: int, length: int, other: int) -> int:
    """Rows, or columns, of a part of a frame: more than ``side`` if the other axis has fewer."""
    return min(length, side * side // min(side, other) // 8 * 8)


def _spread(
    compute: Callable[[Arrays, Weights], Outputs],
    inputs: dict[str, NDArray[Any]],
    weights: Weights,
    arithmetic: Arithmetic,
    part: dict[str, NDArray[Any]] | None = None,
    errors: Errors = (0.0, 0.0),
) -> dict[str, Expected]:
    """The outputs of ``compute``, and their changes by changes of weights and colours of the size of rounding.

    ``part`` is the part of a large frame that gives its bounds.
    """
    exact, changed, open_ = variants(weights, arithmetic)
    truth, part = compute(inputs, exact), inputs if part is None else part
    still = truth if part is inputs else compute(part, exact)
    random = np.random.default_rng(1)
    runs = [compute(_off(part, errors[0], random), each) for each in changed]
    moving = [compute(_off(part, errors[1], random), exact) for _ in changed] if np.any(errors[1]) else []
    sums = compute(part, open_)
    kind = ".stored" if arithmetic.dtype != "float32" else ".winograd" if arithmetic.winograd else ""
    expected: dict[str, Expected] = {}
    for name, want in truth.items():
        spread, slid = (_typical([run[name] - still[name] for run in some]) for some in (runs, moving))
        ungated = BOUNDS["gate"].roundings * arithmetic.unit * np.abs(sums[name]).max(initial=0)
        floor = ungated + BOUNDS["image"].roundings * (arithmetic.unit * np.abs(want).max(initial=0) + arithmetic.tiny)
        rms = BOUNDS[f"rms{kind}"].roundings * spread + slid + floor
        expected[name] = Expected(want, float(BOUNDS["spread"].roundings * (spread + slid) + floor), rms=float(rms))
    return expected


def _typical(moved: Sequence[NDArray[Any]]) -> float:
    """The root mean square, or more where the largest is far beyond it."""
    far = np.abs(moved)
    return max(float(np.sqrt(np.mean(far * far))), float(far.max(initial=0)) / TAIL) if len(far) else 0.0


def _off(inputs: dict[str, NDArray[Any]], error: NDArray[Any] | float, random: np.random.Generator) -> dict[str, NDArray[Any]]:
    """The inputs with each number of the colours off by its largest error, up or down at random."""
    if not np.any(error):
        return inputs
    height, width, _ = inputs["color"].shape
    change = np.asarray(error)[:height, :width] * random.choice((-1, 1), (height, width, 6))
    return {**inputs, "color": inputs["color"] + change}


def layer_change(terms: int, arithmetic: Arithmetic) -> float:
    """Largest relative change of a layer's weights in place of its rounding: gamma_n, and the rounding of stored activations.

    Args:
        terms: number of products in one sum.
        arithmetic: of the port.
    """
    change = (terms + BOUNDS["layer"].roundings) * UNIT["float32"]
    if arithmetic.winograd:
        change *= BOUNDS["layer.winograd"].roundings
    if arithmetic.dtype != "float32":
        change += BOUNDS[f"layer.{arithmetic.dtype}"].roundings * arithmetic.unit
    return change


def variants(weights: Weights, arithmetic: Arithmetic) -> tuple[Weights, list[Weights], Weights]:
    """The weights in float64: as they are, with changes of the size of rounding, and with all gates open; of the sets used last."""
    key = arithmetic, *(id(weights[name]) for name in TENSORS)
    if key in _forms:
        _forms[key] = _forms.pop(key)
    else:
        if len(_forms) == MOST_SETS:
            _forms.pop(next(iter(_forms)))
        exact, random = astype(weights, np.dtype(np.float64)), np.random.default_rng(0)
        changes = _changes(exact, arithmetic)
        _forms[key] = weights, (exact, [_change(exact, changes, random) for _ in range(RUNS)], _open_gates(exact))
    return _forms[key][1]


def _changes(weights: Weights, arithmetic: Arithmetic) -> Tensors:
    """Largest change of each weight."""
    changes: dict[str, NDArray[Any]] = {}
    for name, tensor in weights.items():
        layer = weights[name.replace(".bias", ".weight")]
        size = layer_change(int(np.prod(layer.shape[1:])), arithmetic)
        # Winograd mixes the taps of a window, so that each tap bears the others' rounding errors.
        whole = arithmetic.winograd and tensor.ndim == 4
        scale = np.abs(tensor).max(axis=(2, 3), keepdims=True) if whole else np.abs(tensor)
        changes[name] = scale * size + (arithmetic.spacing if name.endswith(".bias") else 0)
    return changes


def _change(weights: Weights, changes: Tensors, random: np.random.Generator) -> Weights:
    """Drawn by name, so that the same weights have the same bounds for any order of their tensors."""
    arrays: dict[str, NDArray[Any]] = {}
    for name in sorted(weights):
        share = random.random(weights[name].shape, np.float32)
        share *= 2
        share -= 1
        arrays[name] = changes[name] * share
        arrays[name] += weights[name]
        arrays[name].flags.writeable = False  # else the reference copies them
    return replace(weights, tensors=arrays)


def _open_gates(weights: Weights) -> Weights:
    """The weights with all gates open: they give the features, which the rounding error of even a nearly closed gate multiplies."""
    gates = {name: tensor * 0 + (OPEN if name.endswith("bias") else 0) for name, tensor in weights.items() if "conv_mask" in name}
    return weights | gates
