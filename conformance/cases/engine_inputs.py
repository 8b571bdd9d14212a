# SPDX-License-Identifier: MIT
"""Inputs of engines that strategies hardly draw.

Motion of -0, stencils beyond 8 and 16 bits, surplus motions, lost values, colours of either sign, normals along axes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from conformance.cases.large_inputs import frame_case
from conformance.cases.planes import Size
from conformance.cases.stage_inputs import Inputs
from stss_ref.constants import HOLE_FILLS, HoleFill
from stss_ref.weights import SECOND_COLORS, SecondColor, Weights

SIZE = 17, 23
STENCILS = 0.0, 1.0, 255.0, 256.0, 257.0, 2048.0, 2049.0, 65536.0
"""Numbers of objects: 256 is 0 in 8 bits, 65536 in 16; half precision holds no 2049."""
NOT_FINITE = 0.05
"""The share of pixels whose motion is not finite, and of those where it is as long as float32 has it."""
CHAINED = 1e18
"""The longest finite motion that a chain takes: squares of longer ones may overflow, and then rounding decides."""
AXES = np.concatenate([np.eye(3), -np.eye(3)])
"""Normals of walls and floors."""
MORE_MOTIONS = 3
"""Motions behind those that the steps need."""


def _motion(rng: Generator, size: Size, longest: float = float(np.finfo(np.float32).max)) -> NDArray[np.float64]:
    """(H, W, 2) motion, half of it still, as often by -0 as by 0, and some of it lost: not finite, or ``longest`` both ways."""
    still = rng.choice([0.0, -0.0], (*size, 2))
    motion = np.where(rng.random((*size, 1)) < 0.5, still, rng.integers(-6, 7, (*size, 2)) / 4)
    lost = rng.random(size) < NOT_FINITE
    motion[lost, rng.integers(2, size=lost.sum())] = rng.choice([np.nan, np.inf, -np.inf], lost.sum())
    motion[rng.random(size) < NOT_FINITE] = rng.choice([-1, 1]) * longest
    return motion


def _stencils(rng: Generator, size: Size) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Numbers of objects, before and now; a third of the pixels show another one."""
    now = rng.choice(np.array(STENCILS), size)
    return np.where(rng.random(size) < 0.3, rng.choice(np.array(STENCILS), size), now), now


def _holes(rng: Generator) -> Inputs:
    """Nothing but the stencil decides."""
    previous, now = _stencils(rng, SIZE)
    up, none = np.broadcast_to([0.0, 0.0, 1.0], (*SIZE, 3)), np.zeros((*SIZE, 3))
    return {
        "motion": rng.choice([0.0, -0.0, 1.0], (*SIZE, 2)), "stencil_previous": previous, "stencil": now,
        "normal_previous": up, "normal": up, "position_previous": none, "position": none,
        "nov": rng.uniform(-1, 1, SIZE), "depth": rng.random(SIZE), "paper": rng.integers(0, 2, 1, np.int32),
    }  # fmt: skip


def _far_from_home(rng: Generator) -> Inputs:
    """Positions about 2^23, where float32 holds whole numbers alone: differences of them are exact, and interpolated ones are not."""
    position = 2.0**23 + rng.integers(0, 4, (*SIZE, 3))
    still = {name: array for name, array in _holes(rng).items() if not name.startswith("stencil")}
    moved = {"motion": rng.integers(-6, 7, (*SIZE, 2)) / 4, "position": position}
    flat = dict.fromkeys(("stencil", "stencil_previous"), np.zeros(SIZE))
    there = position + rng.integers(-1, 2, position.shape)
    return {**still, **flat, **moved, "position_previous": there, "paper": np.zeros(1, np.int32)}


def _occlusion_warp(rng: Generator) -> Inputs:
    color, warped = rng.random((2, *SIZE, 3))
    valid = (rng.random(SIZE) < 0.5).astype(np.uint8)
    return {"color": color, "warped": warped, "motion": _motion(rng, SIZE), "depth": rng.random(SIZE), "valid": valid}


def _reshade(rng: Generator) -> Inputs:
    """Motion of -0, lost motion, numbers of objects that 8 or 16 bits confuse, colours of either sign, and walls, all at one place."""
    previous, now = _stencils(rng, SIZE)
    color, warped = rng.uniform(-0.5, 1, (2, *SIZE, 3))
    normal_previous, normal = (AXES[numbers.astype(int) % len(AXES)] for numbers in (previous, now))
    none = np.zeros((*SIZE, 3))
    return {
        "color": color, "warped": warped, "motion": _motion(rng, SIZE), "valid": (rng.random(SIZE) < 0.5).astype(np.uint8),
        "stencil_previous": previous, "stencil": now, "normal_previous": normal_previous, "normal": normal,
        "position_previous": none, "position": none, "base_color": rng.random((*SIZE, 3)),
    }  # fmt: skip


def _accumulate(rng: Generator) -> Inputs:
    image, *earlier = rng.random((3, 2 * SIZE[0], 2 * SIZE[1], 3))
    return {"image": image, "earlier": np.stack(earlier), "motions": np.stack([_motion(rng, SIZE) for _ in earlier])}


def _frame(second: SecondColor, fill: HoleFill, rng: Generator) -> tuple[Inputs, Weights]:
    """Lost motion and lost positions lie in every frame, and stencils of every size."""
    inputs, weights = frame_case(SIZE, rng, second, fill=fill)
    values = rng.choice([np.nan, np.inf, -np.inf], SIZE)
    motions = np.stack([_motion(rng, SIZE, CHAINED) for _ in range(len(inputs["motions"]) + MORE_MOTIONS)])
    positions = inputs["positions"].copy()
    for plane in (*motions, *positions):
        where = rng.random(SIZE) < 0.03
        plane[where, 0] = values[where]
    previous, now = _stencils(rng, SIZE)
    return {**inputs, "motions": motions, "positions": positions, "stencils": np.stack([now, previous, now, previous])}, weights


_MAKERS: dict[str, tuple[Callable[[Generator], Any], ...]] = {
    "motion_chain": (lambda rng: {"motions": np.stack([_motion(rng, SIZE), *(_motion(rng, SIZE, CHAINED) for _ in range(2))])},),
    "warp": (lambda rng: {"color": rng.random((*SIZE, 3)), "motion": _motion(rng, SIZE)},),
    "holes": (_holes, _far_from_home), "occlusion_warp": (_occlusion_warp,), "reshade": (_reshade,),
    "frame": tuple(partial(_frame, second, fill) for second, fill in zip(SECOND_COLORS, HOLE_FILLS, strict=True)),
    "accumulate": (_accumulate,),
}  # fmt: skip

ENGINE_STAGES = frozenset(_MAKERS)
"""Stages that have such cases."""


def engine_inputs(stage: str) -> tuple[Callable[[Generator], Any], ...]:
    """Such cases of a stage: inputs, and weights if the stage takes them."""
    return _MAKERS[stage]
