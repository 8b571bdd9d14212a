# SPDX-License-Identifier: MIT
"""Inputs of stage holes whose comparisons need all bits of float32: a lost one decides a hole. Nothing moves in them."""

from __future__ import annotations

import numpy as np

from conformance.cases.planes import Size
from conformance.cases.stage_inputs import Inputs
from stss_ref.constants import HoleLimits

SIZE: Size = (32, 32)


def hardly_far(rng: np.random.Generator) -> Inputs:
    """The paper's distances are 1/500,000 beyond their limits, or below: those of every other pixel and row, since a pixel reads four."""
    nov, depth = rng.uniform(-1, 1, SIZE), rng.random(SIZE)
    limits, facing = HoleLimits(), np.abs(nov)
    limit = limits.facing * facing + limits.grazing * (1 - facing) + limits.depth * depth
    decides = (np.indices(SIZE) % 2 == 0).all(axis=0)
    previous = np.zeros((*SIZE, 3))
    previous[..., 2] = np.where(decides, limit * (1 + rng.choice([-2e-6, 2e-6], SIZE)), 0)
    return {**_nothing(), "position_previous": previous, "nov": nov, "depth": depth, "paper": np.ones(1, np.int32)}


def hardly_turned(rng: np.random.Generator) -> Inputs:
    """Cosines are 1/50,000 above their limits, or below, of static and of moving surfaces."""
    objects = 2.0 * rng.integers(0, 2, SIZE)
    limits = HoleLimits()
    limit = np.where(objects == 0, limits.static_cosine, limits.cosine) * (1 + 1e-5)  # 1e-5 stands beside the length
    angle = np.arccos(limit + rng.choice([-2e-5, 2e-5], SIZE))
    up, aside = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    turned = np.cos(angle)[..., None] * up + np.sin(angle)[..., None] * aside
    normal = np.broadcast_to(up, turned.shape)
    return {**_nothing(), "stencil": objects, "stencil_previous": objects, "normal": normal, "normal_previous": turned}


def _nothing() -> Inputs:
    names = {"motion": 2, "normal": 3, "normal_previous": 3, "position": 3, "position_previous": 3}
    planes = {name: np.zeros(SIZE) for name in ("stencil", "stencil_previous", "nov", "depth")}
    return {**planes, **{name: np.zeros((*SIZE, channels)) for name, channels in names.items()}, "paper": np.zeros(1, np.int32)}
