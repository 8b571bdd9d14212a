# SPDX-License-Identifier: MIT
"""Inputs of stages holes and frame whose comparisons need all bits of float32: a lost one decides a hole, or its fill."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.random import Generator

from conformance.cases.planes import Size
from conformance.cases.stage_inputs import Inputs, make_weights
from stss_ref.constants import HoleLimits
from stss_ref.weights import Weights

SIZE: Size = (32, 32)


def hardly_far(rng: Generator, part: float = 2e-6) -> Inputs:
    """The paper's distances are beyond their limits by a small part, or below: at every other pixel and row, since a pixel reads four."""
    nov, depth = rng.uniform(-1, 1, SIZE), rng.random(SIZE)
    limits, facing = HoleLimits(), np.abs(nov)
    limit = limits.facing * facing + limits.grazing * (1 - facing) + limits.depth * depth
    decides = (np.indices(SIZE) % 2 == 0).all(axis=0)
    previous = np.zeros((*SIZE, 3))
    previous[..., 2] = np.where(decides, limit * (1 + rng.choice([-part, part], SIZE)), 0)
    return {**_nothing(), "position_previous": previous, "nov": nov, "depth": depth, "paper": np.ones(1, np.int32)}


def hardly_turned(rng: Generator) -> Inputs:
    """Cosines are 1/50,000 above their limits, or below, of static and of moving surfaces."""
    objects = 2.0 * rng.integers(0, 2, SIZE)
    limits = HoleLimits()
    limit = np.where(objects == 0, limits.static_cosine, limits.cosine) * (1 + 1e-5)  # 1e-5 stands beside the length
    angle = np.arccos(limit + rng.choice([-2e-5, 2e-5], SIZE))
    up, aside = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    turned = np.cos(angle)[..., None] * up + np.sin(angle)[..., None] * aside
    normal = np.broadcast_to(up, turned.shape)
    return {**_nothing(), "stencil": objects, "stencil_previous": objects, "normal": normal, "normal_previous": turned}


def near_frames() -> tuple[Callable[[Generator], tuple[Inputs, Weights]], ...]:
    """Stage frame: the surfaces of `hardly_far` and of `hardly_turned` in each colour frame; and `_hardly_behind`."""
    # Of 1/500,000 rounding decides at some pixels, and a frame with one of them is not judged.
    surfaces = (partial(hardly_far, part=1e-5), hardly_turned)
    return (*(partial(_still_frame, each) for each in surfaces), _hardly_behind)


def _still_frame(surfaces: Callable[[Generator], Inputs], rng: Generator) -> tuple[Inputs, Weights]:
    inputs = surfaces(rng)
    buffers = {
        f"{name}s": np.stack([inputs[name], *[inputs[f"{name}_previous"]] * 3]) for name in ("stencil", "normal", "position")
    }
    gbuffer = rng.random((*SIZE, 9))
    gbuffer[..., 3] = inputs["depth"]
    frame: Inputs = {
        "colors": rng.random((3, *SIZE, 3)), "steps": np.array((1, 2, 3), np.int32), "motions": np.zeros((3, *SIZE, 2)),
        "gbuffer": gbuffer, "nov": inputs["nov"], **buffers,
    }  # fmt: skip
    return frame, make_weights("random", 0, test="paper" if inputs["paper"][0] else "footprint")


def _hardly_behind(rng: Generator) -> tuple[Inputs, Weights]:
    """Surfaces move over each other whose depths differ in the last 8 bits of float32; every other pixel is another object's hole."""
    frame, weights = _still_frame(lambda _: _nothing(), rng)
    depth = 2.0**-7 + rng.integers(0, 256, SIZE) * 2.0**-30
    frame["gbuffer"][..., 3] = depth
    frame["stencils"][1:] = 2.0 * rng.integers(0, 2, SIZE)
    return {**frame, "motions": rng.integers(-8, 9, (3, *SIZE, 2)) / 2}, weights


def _nothing() -> Inputs:
    names = {"motion": 2, "normal": 3, "normal_previous": 3, "position": 3, "position_previous": 3}
    planes = {name: np.zeros(SIZE) for name in ("stencil", "stencil_previous", "nov", "depth")}
    return {**planes, **{name: np.zeros((*SIZE, channels)) for name, channels in names.items()}, "paper": np.zeros(1, np.int32)}
