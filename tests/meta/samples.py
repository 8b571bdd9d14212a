# SPDX-License-Identifier: MIT
"""Inputs on which every mistake of ``conformance.mistakes`` shows."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.cases.constants import FAINT
from conformance.cases.engine_inputs import ENGINE_STAGES, engine_inputs
from conformance.cases.every_buffer import frame_cases
from conformance.cases.near_limits import hardly_far, hardly_turned, near_frames
from conformance.protocol.port import Case, Outputs
from conformance.protocol.stages import STAGES
from conformance.tolerance import ratio
from stss_ref.constants import HoleFill, HoleTest
from stss_ref.weights import SecondColor, Weights, random

Size = tuple[int, int]


@cache
def samples(stage: str) -> tuple[Case, ...]:
    """Some inputs of ``stage``, the same at every call."""
    assert stage in _SAMPLES, f"{stage}: no samples; expected a row of tests/meta/samples.py"
    generator = np.random.default_rng(list(STAGES).index(stage))
    more = (make(generator) for make in engine_inputs(stage)) if stage in ENGINE_STAGES else ()
    pairs = [*_SAMPLES[stage](generator), *(case if STAGES[stage].weights else (case, None) for case in more)]
    return tuple(Case(stage, _float32(inputs), weights) for inputs, weights in pairs)


def _float32(inputs: dict[str, Any]) -> dict[str, Any]:
    return {name: np.ascontiguousarray(a, np.float32 if a.dtype.kind == "f" else a.dtype) for name, a in inputs.items()}


SIZES: tuple[Size, ...] = ((9, 7), (19, 23), (12, 33), (1, 9), (6, 1), (1, 1))
KINDS = ("short", "half", "swapped", "whole", "broken", "long")
CASES = (*product(SIZES, KINDS), ((20, 40), "beside"))


def motion(generator: np.random.Generator, size: Size, kind: str) -> NDArray[Any]:
    """(H, W, 2) that leads to fractions, halves, equally long ones, whole pixels, just beside those, nowhere, or far outside."""
    shape = (*size, 2)
    if kind == "half":
        return generator.integers(-5, 6, shape) / 2
    if kind == "swapped":
        pair = generator.permuted(np.broadcast_to(generator.uniform(1, 3, (4, 1, 2)), (4, size[0] * size[1], 2)), axis=-1)
        return generator.permuted(pair, axis=0)[0].reshape(shape) * generator.choice([-1, 1], shape)
    if kind == "whole":
        return generator.integers(-2, 3, shape).astype(np.float64)
    if kind == "beside":
        # float32 holds the fraction, but no sum with a pixel from 9 on.
        return generator.integers(-2, 3, shape) + generator.choice([-1, 1], shape) * 2.0**-22
    if kind == "long":
        return generator.uniform(-1.2, 1.2, shape) * max(size)
    moved = generator.uniform(-2, 2, shape) * (generator.random((*size, 1)) < 0.9)
    if kind == "broken":
        moved[generator.random(shape) < 0.08] = np.nan
        moved[generator.random(shape) < 0.04] = np.inf
        moved[generator.random(size) < 0.1] = generator.choice([-1e-3, 1e-3], 2)
    return moved


def _motion_chain(generator: np.random.Generator) -> Any:
    for size, kind in CASES:
        motions = np.stack([motion(generator, size, kind) for _ in range(3)])
        yield {"motions": motions}, None
    yield {"motions": generator.choice([-1.0, 1.0], (7, 12, 12, 2))}, None


def _warp(generator: np.random.Generator) -> Any:
    for size, kind in CASES:
        yield {"color": generator.random((*size, 18)), "motion": motion(generator, size, kind)}, None
    wide = 1, 4096
    yield {"color": generator.random((*wide, 6)), "motion": motion(generator, wide, "short")}, None


def _surface(generator: np.random.Generator, size: Size) -> tuple[Any, Any, Any]:
    """Stencil, normal, position of a frame: mostly one plane, some moving objects, some background, some broken pixels."""
    y, x = np.indices(size)
    stencil = generator.choice([0.0, 0, 0, 1, 2], size) * (x + y > 3)
    position = np.stack([6.0 * x, 6.0 * y, 500 + generator.normal(0, 12, size)], axis=-1)
    position[generator.random(size) < 0.03] = np.nan
    normal = np.array([0.0, 0, 1]) + generator.normal(0, 0.12, (*size, 3))
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal * generator.choice([1.0, 1, 1, 0.97, 0, -1], (*size, 1))
    return stencil, normal, position


def _holes(generator: np.random.Generator) -> Any:
    for size, kind in CASES:
        before, now = _surface(generator, size), _surface(generator, size)
        pairs = zip(("stencil", "normal", "position"), before, now, strict=True)
        inputs = {key: a for name, b, n in pairs for key, a in ((f"{name}_previous", b), (name, n))}
        inputs["motion"] = motion(generator, size, kind) / 2
        inputs["nov"], inputs["depth"] = generator.uniform(-1, 1, size), generator.random(size)
        for paper in (0, 1, 2):
            yield {**inputs, "paper": np.array([paper], np.int32)}, None
        leaning = np.linspace(0, np.pi, size[0] * size[1]).reshape(size)
        still = {
            "motion": np.zeros_like(inputs["motion"]), "position_previous": inputs["position"], "paper": np.zeros(1, np.int32),
            "normal_previous": np.stack([np.sin(leaning), 0 * leaning, np.cos(leaning)], axis=-1),
        }  # fmt: skip
        yield {**inputs, **still}, None
    yield from ((make(generator), None) for make in (hardly_far, hardly_turned))


def _occlusion_warp(generator: np.random.Generator) -> Any:
    for size, kind in CASES:
        color, warped = generator.random((2, *size, 3))
        ties = generator.choice([0.0, -0.0, 2**-9 + 2**-32, 2**-9 + 2**-31, 1.0], size)
        depth = np.where(generator.random(size) < 0.3, ties, generator.random(size))
        valid = (generator.random(size) < 0.5).astype(np.uint8)
        yield (
            {"color": color, "warped": warped, "motion": motion(generator, size, kind), "depth": depth, "valid": valid},
            None,
        )


def _reshade(generator: np.random.Generator) -> Any:
    for size, kind in CASES:
        before, now = _surface(generator, size), _surface(generator, size)
        pairs = zip(("stencil", "normal", "position"), before, now, strict=True)
        inputs = {key: a for name, b, n in pairs for key, a in ((f"{name}_previous", b), (name, n))}
        inputs["color"], inputs["warped"] = generator.uniform(-0.3, 1.3, (2, *size, 3))
        inputs["motion"], inputs["base_color"] = motion(generator, size, kind) / 2, generator.uniform(-0.3, 1.3, (*size, 3))
        inputs["valid"] = (generator.random(size) < 0.5).astype(np.uint8)
        yield inputs, None
    inputs["normal"] = inputs["normal"] + (generator.random((*size, 1)) < 0.1) * FAINT
    yield inputs, None
    yield {**inputs, "normal": inputs["normal"] * 0.4}, None  # mixed with a background


def _rrm(generator: np.random.Generator) -> Any:
    for rectangle in ((2, 1, 3, 2), (0, 0, 1, 4), (5, 3, 4, 9)):
        valid = (generator.random((9, 12)) < 0.7).astype(np.uint8)
        yield {"valid": valid, "rectangle": np.array(rectangle, np.int32)}, None


def _accumulate(generator: np.random.Generator) -> Any:
    for (height, width), kind in CASES:
        image, *earlier = generator.uniform(-0.3, 1.3, (3, 2 * height, 2 * width, 3))
        moved = np.stack([motion(generator, (height, width), kind) / 2 for _ in earlier])
        yield {"image": image, "earlier": np.stack(earlier), "motions": moved}, None
        yield {"image": image, "earlier": image + np.stack(earlier[:1]) / 2, "motions": moved[:1]}, None


@cache
def weights_of(kind: str) -> Weights:
    """Weights that keep a signal's size, that enlarge it, or whose materials are almost 0, or large."""
    weights = random(7)
    factors = {
        "plain": {}, "loud": {"": 1.8, "conv_feature.weight": 1.6}, "faint": {"KEncoder.4": 2.0**-12},
        "long": {"KEncoder.4": 2.0**12},
    }[kind]  # fmt: skip
    for part, factor in factors.items():
        weights |= {name: np.float32(factor) * tensor for name, tensor in weights.items() if part in name}
    return weights


def _features(generator: np.random.Generator, height: int, width: int) -> dict[str, Any]:
    """The network's inputs and its inner features."""
    half, quarter, eighth = ((height // n, width // n) for n in (2, 4, 8))
    # In blocks, so that at 1/8 size there are pixels of every mask, and whole windows of holes.
    mask = (generator.random((height, width)) < 0.8) & (np.arange(width) // 8 % 7 < 4)
    inner = {"x1": (height, width, 24), "x2": (*half, 24), "x3": (*quarter, 32), "x4": (*eighth, 32)}
    outer = {"reshaded": (*eighth, 64), "feature": (*eighth, 32)}
    features = {name: np.maximum(generator.normal(0, 1, shape), 0) for name, shape in (inner | outer).items()}
    features["color"] = generator.random((height, width, 6))
    features["gbuffer"] = generator.random((height, width, 9))
    features["mask"] = mask.astype(np.float64)
    features["history"] = generator.random((3, height, width, 4))
    return features


def _networks(stage: str, generator: np.random.Generator) -> Any:
    sizes = [(16, 24), (40, 56)] if stage != "network" else [(13, 18), (16, 24), (8, 9)]
    # Through the whole network loud weights amplify rounding errors beyond any bound.
    kinds = ("plain", "faint", *(("loud",) if stage != "network" else ()), *(("long",) if stage == "erm" else ()))
    for height, width in sizes:
        for kind in kinds:
            features = _features(generator, height, width)
            yield {name: features[name] for name in STAGES[stage].inputs}, weights_of(kind)


def _frame(generator: np.random.Generator) -> Any:
    for steps in ((1, 3, 5), (0, 2, 4), (1, 3, 3), (0, 2, 2), (1, 1, 1)):
        size = (11, 16)
        surfaces = zip(*(_surface(generator, size) for _ in range(4)), strict=True)
        inputs: dict[str, Any] = dict(zip(("stencils", "normals", "positions"), map(np.stack, surfaces), strict=True))
        inputs["colors"] = generator.uniform(-0.3, 1.3, (3, *size, 3))
        inputs["motions"] = np.stack([motion(generator, size, "short") / 4 for _ in range(5)])
        inputs["gbuffer"], inputs["nov"] = generator.random((*size, 9)), generator.uniform(-1, 1, size)
        inputs["steps"] = np.array(steps, np.int32)
        settings: tuple[tuple[SecondColor, HoleTest, HoleFill], ...] = (
            ("newest", "footprint", "occlusion_warp"),
            ("detail", "paper", "reshade"),
        )
        for second, test, fill in settings:
            yield inputs, Weights(weights_of("plain"), second, test, fill)
    yield from (make(generator) for make in (*frame_cases()[::2], *near_frames()))


AHEAD: frozenset[str] = frozenset()
"""Stages that the example ports, in C++ and WGSL, do not have yet."""

_SAMPLES: dict[str, Callable[[np.random.Generator], Any]] = {
    "motion_chain": _motion_chain,
    "warp": _warp,
    "holes": _holes,
    "occlusion_warp": _occlusion_warp,
    "reshade": _reshade,
    "rrm": _rrm,
    "frame": _frame,
    "accumulate": _accumulate,
    **{stage: partial(_networks, stage) for stage in ("history", "encoder", "erm", "decoder", "network")},
}


def departs(got: Outputs, want: Outputs, row: str | None) -> bool:
    """Whether outputs differ by more than ``row`` of the table of bounds allows, or at all if ``row`` is None; masks may never differ.

    The row's floor is meant for numbers of order 1, so larger outputs are divided by their largest number.
    """
    for name, right in want.items():
        if right.dtype == np.uint8 or row is None:
            if not np.array_equal(got[name], right, equal_nan=right.dtype.kind == "f"):
                return True
            continue
        finite = np.isfinite(right) & np.isfinite(got[name])
        if not np.array_equal(got[name][~finite], right[~finite], equal_nan=True):
            return True
        largest = max(1, np.abs(right[finite]).max(initial=0))
        if ratio(row, got[name][finite] / largest, right[finite] / largest) > 1:
            return True
    return False
