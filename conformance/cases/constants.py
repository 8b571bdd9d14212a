# SPDX-License-Identifier: MIT
"""Every constant of the specification, with a case that shows it: without it, or with another value, the answer is clearly wrong.

Drawn cases hardly ever show a constant: that takes sums of weights about 1e-6, lengths about 1e-5, or distances just below a limit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from conformance.cases.large_inputs import frame_case
from conformance.cases.stage_inputs import Inputs, make_weights
from stss_ref.constants import EARLIER_SHARES, SLOW, HoleLimits
from stss_ref.holes import LEAST_LENGTH
from stss_ref.reshade import COSINE, FOOTPRINTS, REACH, STATIC_COSINE, STEPS, UNMIXED
from stss_ref.weights import Weights

LIMITS = HoleLimits()
CLOSE = 2.0**-9, 2.0**-17
"""Relative distances of numbers from their limit: beyond the rounding of float16, and within what a limit in float16 is off by."""
FAINT = 1e-8
"""Length of a surface's normal, close to 0; a background's normal is 0."""


@dataclass(frozen=True)
class Constant:
    """One number of the specification.

    Attributes:
        name: the constant, in words.
        value: as docs/stages.md has it.
        stage: the constant shows in this stage.
        make: makes a case of that stage from a seeded generator.
    """

    name: str
    value: str
    stage: str
    make: Callable[[Generator], Any]


def _pairs(*numbers: float) -> NDArray[np.float64]:
    """(1, 2 N): each number in two columns, so that a still pixel in the first of them reads no other."""
    return np.repeat(np.array(numbers, np.float64), 2)[None]


def _around(*limits: float) -> NDArray[np.float64]:
    """`_pairs` of numbers close below and above each limit."""
    return _pairs(*(limit * (1 + sign * close) for limit in limits for close in CLOSE for sign in (-1, 1)))


def _still(width: int) -> Inputs:
    """Stage holes: one row of a frame in which nothing moves and nothing changed."""
    up = np.broadcast_to([0.0, 0.0, 1.0], (1, width, 3))
    flat, none = np.zeros((1, width)), np.zeros((1, width, 3))
    return {
        "motion": np.zeros((1, width, 2)), "stencil_previous": flat, "stencil": flat, "normal_previous": up, "normal": up,
        "position_previous": none, "position": none, "nov": flat, "depth": flat,
        "paper": np.ones(1, np.int32),
    }  # fmt: skip


def _far(facing: float, depth: float) -> Callable[[Generator], Inputs]:
    bias = LIMITS.facing * facing + LIMITS.grazing * (1 - facing) + LIMITS.depth * depth

    def make(_: Generator) -> Inputs:
        apart = _around(bias)
        moved = np.stack([apart, np.zeros_like(apart), np.zeros_like(apart)], axis=-1)
        planes = {"nov": np.full_like(apart, facing), "depth": np.full_like(apart, depth)}
        return {**_still(apart.size), **planes, "position_previous": moved}

    return make


def _footprint(_: Generator) -> Inputs:
    """Two rows of columns that are 8 cm apart in both directions, so that a footprint is 8 sqrt(2) cm; the last column has no position."""
    apart = (
        np.sqrt(128) * LIMITS.footprints * np.array([*(1 + sign * close for close in CLOSE for sign in (-1, 1)), 1 - CLOSE[0], 0])
    )
    here = np.zeros((2, apart.size, 3))
    here[..., 0], here[..., 1] = 8 * np.arange(apart.size), 8 * np.arange(2)[:, None]
    there = here.copy()
    there[..., 2] = apart
    here[:, -1] = np.nan
    still = _still(apart.size)
    planes = {name: np.repeat(array, 2, axis=0) for name, array in still.items()}
    return {**planes, "position": here, "position_previous": there, "paper": np.zeros(1, np.int32)}


def _object(normal_previous: NDArray[np.float64]) -> Inputs:
    ones = np.ones(normal_previous.shape[:2])
    return {**_still(ones.size), "stencil": ones, "stencil_previous": ones, "normal_previous": normal_previous}


def _lean(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normals of length 1 at these cosines to z."""
    return np.stack([np.sqrt(1 - cosine**2), np.zeros_like(cosine), cosine], axis=-1)


def _cosine(_: Generator) -> Inputs:
    return _object(_lean(_around(LIMITS.cosine * (1 + LEAST_LENGTH))))


def _static_cosine(_: Generator) -> Inputs:
    """Of static surfaces that stay where they are; the paper's test does not ask for their normals."""
    normals = _lean(_around(LIMITS.static_cosine * (1 + LEAST_LENGTH)))
    return {**_still(normals.shape[1]), "normal_previous": normals, "paper": np.zeros(1, np.int32)}


def _length(_: Generator) -> Inputs:
    """Normals of one direction and of several lengths; at 4.9e-4 ``|n| / (|n| + 1e-5)`` is 0.98, and hardly changes with the length."""
    near = [49 * LEAST_LENGTH * (1 + part) for part in (-0.05, -(2.0**-13), 2.0**-13, 0.05)]
    length = _pairs(1e-6, 1e-5, 1e-4, *near, 2e-3)
    return _object(np.stack([np.zeros_like(length), np.zeros_like(length), length], axis=-1))


def _hardly_there(_: Generator) -> Inputs:
    """An object whose normals were 0, and now are 0 or hardly longer."""
    length = _pairs(0, FAINT, 1e-4)
    inputs = _object(np.zeros((*length.shape, 3)))
    return inputs | {"normal": np.stack([np.zeros_like(length), np.zeros_like(length), length], axis=-1)}


def _mesh(_: Generator) -> Inputs:
    apart = _around(-LIMITS.mesh / 3, LIMITS.mesh / 3)
    ones = np.ones_like(apart)
    return {**_still(apart.size), "stencil": ones, "stencil_previous": ones + apart}


def _farthest(rng: Generator) -> Inputs:
    """A few pixels that splat, on a ground that is too far to splat."""
    depth = np.full((1, 20), 20.0)
    depth[0, ::5] = 10 * (1 - CLOSE[0]), 10, 10 * (1 + CLOSE[0]), 9
    motion = np.zeros((1, 20, 2))
    motion[..., 0] = 1.25
    valid = np.zeros((1, 20), np.uint8)
    return {"color": rng.random((1, 20, 3)), "warped": rng.random((1, 20, 3)), "motion": motion, "depth": depth, "valid": valid}


def _hole(width: int) -> Inputs:
    """Stage reshade: a row of holes of one material and at one place, that do not move, of which none has a sample of its own."""
    up = np.broadcast_to([0.0, 0.0, 1.0], (1, width, 3))
    flat, none = np.zeros((1, width)), np.zeros((1, width, 3))
    return {
        "color": none, "warped": none, "motion": np.zeros((1, width, 2)), "valid": np.zeros((1, width), np.uint8),
        "stencil_previous": flat + 9, "stencil": flat, "normal_previous": up, "normal": up, "position_previous": none,
        "position": none, "base_color": none,
    }  # fmt: skip


def _own_distance(rng: Generator) -> Inputs:
    """Columns 8 cm apart, so that a footprint is 8 cm; a sample within two footprints is a hole's own."""
    apart = _around(8 * FOOTPRINTS)
    inputs = _hole(apart.size)
    here = np.zeros((1, apart.size, 3))
    here[..., 0] = 8 * np.arange(apart.size)
    there = here.copy()
    there[..., 2] = apart
    return inputs | {
        "color": rng.random(here.shape), "warped": rng.random(here.shape), "stencil_previous": inputs["stencil"],
        "position": here, "position_previous": there, "motion": inputs["motion"] + (0, -0.5),
    }  # fmt: skip


def _own_cosine(least: float, stencil: int) -> Callable[[Generator], Inputs]:
    def make(rng: Generator) -> Inputs:
        normals = _lean(_around(least))
        inputs, size = _hole(normals.shape[1]), (1, normals.shape[1], 3)
        return inputs | {
            "color": rng.random(size), "warped": rng.random(size), "stencil": inputs["stencil"] + stencil,
            "stencil_previous": inputs["stencil"] + stencil, "normal_previous": normals,
        }  # fmt: skip

    return make


MIDDLE = REACH * STEPS[-1] + 1
"""Column of the hole of `_like`, whose row goes one pixel beyond the widest ring on each side."""


def _like(rng: Generator) -> Inputs:
    """One hole among pixels of other materials; some of its own material lie on rings, between them and beyond."""
    width = 2 * MIDDLE + 1
    inputs = _hole(width)
    base_color, normal = np.full((1, width, 3), 8.0), inputs["normal"].copy()
    places = MIDDLE + np.array([[-2, 16, -32, 64], [1, -3, 6, -12], [20, -MIDDLE, MIDDLE, 0]])
    others, turned = MIDDLE - np.array([4, 8, 64]), MIDDLE + np.array([4, 8, 32])
    base_color[0, [*places.flat, *others, *turned]] = 0
    base_color[0, others, 1], normal[0, turned, 0] = (0.03125, 0.125, 1.5), (0.25, 0.5, 1)
    valid = inputs["valid"] + 1
    valid[0, MIDDLE] = 0
    return inputs | {"warped": rng.random((1, width, 3)), "valid": valid, "base_color": base_color, "normal": normal}


def _lights(rng: Generator) -> Inputs:
    """Some holes in a row, which share the lights that they find."""
    inputs = _hole(2 * MIDDLE + 1)
    valid = inputs["valid"] + 1
    valid[0, MIDDLE : MIDDLE + 9] = 0
    return inputs | {"warped": rng.random(inputs["warped"].shape), "valid": valid}


def _mixed(rng: Generator) -> Inputs:
    """Rows of one object each; each has a hole, whose normal is near the limit of a mixed one's, among other materials."""
    squares = np.array([UNMIXED * (1 + sign * close) for close in CLOSE for sign in (-1, 1)])
    row, shape = _like(rng), (squares.size, 1, 1)
    inputs = {name: np.repeat(array, squares.size, axis=0) for name, array in row.items()}
    objects = np.arange(1.0, squares.size + 1)[:, None] + np.zeros(inputs["stencil"].shape)
    return inputs | {
        "normal": inputs["normal"] * np.sqrt(squares).reshape(shape),
        "stencil": objects,
        "stencil_previous": objects + 9,
    }


def _background(rng: Generator) -> Inputs:
    """One hole in a background, beside the edge of a surface."""
    inputs = _like(rng)
    normal = inputs["normal"] * 0
    normal[0, MIDDLE - 4 : MIDDLE - 1] = 0, 0, 1
    return inputs | {"normal": normal, "base_color": inputs["base_color"] * 0}


def _faint(rng: Generator) -> Inputs:
    """The hole's normal is hardly longer than a background's: it takes from the surface alone."""
    inputs = _background(rng)
    normal = inputs["normal"].copy()
    normal[0, MIDDLE, 2] = FAINT
    return inputs | {"normal": normal}


def _materials(rng: Generator) -> tuple[Inputs, Weights]:
    """A few places with keys about 1e-12 long, among keys a million times shorter: sums of weights are about 1e-6, lengths 1e-12."""
    size = 9, 9
    keys = 1e-6 * rng.choice([1e-3, 0.1, 0.3, 0.6, 2.0], size)
    keys[1::4, 1::4] = rng.choice([1.0, 2.0, 5.0], (2, 2))
    return _lit(rng, keys, np.ones(size))


def _window(rng: Generator) -> tuple[Inputs, Weights]:
    """One place is trusted: its light reaches places up to two away, and no further."""
    trusted = np.zeros((9, 9))
    trusted[4, 4] = 1
    return _lit(rng, np.full((9, 9), 1e3), trusted)


def _lit(rng: Generator, keys: NDArray[np.float64], trusted: NDArray[np.float64]) -> tuple[Inputs, Weights]:
    """Stage erm with keys that are 1e-12 times ``keys``."""
    height, width = keys.shape
    weights = dict(make_weights("random", 0))
    for name, tensor in weights.items():
        if name.startswith("KEncoder"):
            weights[name] = np.zeros_like(tensor)
            if name.endswith("weight"):
                weights[name][0, 0, 1, 1] = 1e-12 if name == "KEncoder.4.weight" else 1
    gbuffer = np.zeros((8 * height, 8 * width, 9))
    gbuffer[..., 0] = keys.repeat(8, axis=0).repeat(8, axis=1)
    inputs: Inputs = {"x4": rng.normal(0, 1, (height, width, 32)), "gbuffer": gbuffer}
    return {**inputs, "mask": trusted.repeat(8, axis=0).repeat(8, axis=1)}, Weights(weights)


def _dark(rng: Generator) -> tuple[Inputs, Weights]:
    """Stage frame with colours of either sign."""
    inputs, weights = frame_case((9, 13), rng)
    return {**inputs, "colors": inputs["colors"] * 2 - 1}, weights


def _mix(_: Generator) -> Inputs:
    """Black and white pixels in turn, the opposite just before, and the same before that on the left."""
    image = np.repeat(np.indices((4, 4)).sum(axis=0)[..., None] % 2, 3, axis=-1).astype(np.float64)
    older = np.concatenate([image[:, :2], 1 - image[:, 2:]], axis=1)
    return {"image": image, "earlier": np.stack([1 - image, older]), "motions": np.zeros((2, 2, 2, 2))}


def _slow(_: Generator) -> Inputs:
    """Black and white pixels in turn, the opposite before; motion of 3 to 8 pixels in each direction, whole or in halves."""
    lengths = np.array([3, 3.5, 4, 4.5, 5, 6, 8])
    image = np.repeat(np.indices((28, 36)).sum(axis=0)[..., None] % 2, 3, axis=-1).astype(np.float64)
    across = lengths.repeat(2)[:, None] * np.where(np.arange(18) < 9, 1, -1)
    diagonal = np.stack([np.floor(across / 1.25), np.zeros((14, 18))], axis=-1)
    diagonal[..., 1] = np.where(np.arange(14) < 7, 3, -3)[:, None]
    straight = np.stack([across, np.zeros((14, 18))], axis=-1)
    return {"image": image, "earlier": np.stack([1 - image] * 2), "motions": np.stack([diagonal, straight])}


CONSTANTS = (
    Constant("distance in footprints", "1.5", "holes", _footprint),
    Constant("distance head-on", "7.5", "holes", _far(1, 0)),
    Constant("distance edge-on", "45", "holes", _far(0, 0)),
    Constant("distance by depth", "50", "holes", _far(1, 1)),
    Constant("cosine", "0.98", "holes", _cosine),
    Constant("cosine of static surfaces", "0.5", "holes", _static_cosine),
    Constant("what is added to a normal's length", "1e-5", "holes", _length),
    Constant("length of a background's normals", "0", "holes", _hardly_there),
    Constant("difference of stencils", "1", "holes", _mesh),
    Constant("stencil's channels", "3", "holes", _mesh),
    Constant("beginning of the depth buffer", "10", "occlusion_warp", _farthest),
    Constant("own samples' distance in footprints", "2", "reshade", _own_distance),
    Constant("own samples' cosine", "0.95", "reshade", _own_cosine(COSINE, 1)),
    Constant("own samples' cosine, static", "0.5", "reshade", _own_cosine(STATIC_COSINE, 0)),
    Constant("places to the sides of a ring", "2", "reshade", _like),
    Constant("pixels to the sides of the square of lights", "2", "reshade", _lights),
    Constant("steps of the rings", "1, 2, 4, 8, 16, 32", "reshade", _like),
    Constant("weight of base colours", "1", "reshade", _like),
    Constant("weight of normals", "2", "reshade", _like),
    Constant("least a base colour reflects", "0.015625", "reshade", _like),
    Constant("most a base colour reflects", "1", "reshade", _like),
    Constant("squared length of a mixed normal", "0.25", "reshade", _mixed),
    Constant("weight of distances on a background", "0.25", "reshade", _background),
    Constant("length of a background's own normal", "0", "reshade", _faint),
    Constant("power of a weight", "4", "reshade", _like),
    Constant("least length of a key", "1e-12", "erm", _materials),
    Constant("least sum of weights", "1e-6", "erm", _materials),
    Constant("window", "5", "erm", _window),
    Constant("least colour", "0", "frame", _dark),
    Constant("share of the newer image", str(EARLIER_SHARES[0]), "accumulate", _mix),
    Constant("share of the older image", str(EARLIER_SHARES[1]), "accumulate", _mix),
    Constant("longest motion of a whole share", f"{SLOW:g}", "accumulate", _slow),
)


def pinned_by(make: Callable[[Generator], Any]) -> str:
    """Words on the constants that a case is made for."""
    return "the case is made for " + " and ".join(f"{each.name} ({each.value})" for each in CONSTANTS if each.make is make)


def constant_cases(stage: str) -> tuple[Callable[[Generator], Any], ...]:
    """The cases that show a stage's constants."""
    return tuple(dict.fromkeys(constant.make for constant in CONSTANTS if constant.stage == stage))
