# SPDX-License-Identifier: MIT
"""Stage frame in which every buffer of every frame decides about some pixels alone, for each choice of steps.

Drawn cases may have buffers that are alike, or steps for which a mistake gives the right answer: then only some seeds show it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.random import Generator

from conformance.cases.stage_inputs import Inputs, make_weights
from stss_ref.weights import SECOND_COLORS, SecondColor, Weights

STEPS = ((0, 2, 4), (1, 3, 5), (1, 3, 3), (1, 1, 1), (2, 3, 5))
MOVES = (1.25, 0), (0.25, 2), (2, 0.5), (0.5, -3.25), (-5, 0.25)
"""Pixels from each display frame to the previous one; all sums of them from one frame on differ."""
BLOCK = 8
SIZE = 3 * BLOCK, 4 * BLOCK
FAR = 256.0
"""Cm: farther than any two points of one surface."""


def frame_cases() -> tuple[Callable[[Generator], tuple[Inputs, Weights]], ...]:
    """A case for each choice of steps and each second colour: pixels of the earlier frame are valid in some places and not in others."""
    return tuple(partial(_frame, steps, second) for second in SECOND_COLORS for steps in STEPS)


def _frame(steps: tuple[int, int, int], second: SecondColor, rng: Generator) -> tuple[Inputs, Weights]:
    """Colour frame i has holes in the i-th block of three rows of blocks: by its stencil, its normal and its position."""
    stencils, positions = np.zeros((4, *SIZE)), np.zeros((4, *SIZE, 3))
    normals = np.broadcast_to([0.0, 0.0, 1.0], (4, *SIZE, 3)).copy()
    by_stencil, by_normal, by_position = (slice(i * BLOCK, (i + 1) * BLOCK) for i in range(3))
    stencils[:, by_normal] = 2  # normals count on what moves by itself
    for i in range(3):
        block = slice(i * BLOCK, (i + 1) * BLOCK)
        stencils[i + 1, by_stencil, block] = 2
        normals[i + 1, by_normal, block] *= -1
        positions[i + 1, by_position, block, 0] = FAR
    moves = np.array(MOVES, np.float64)[: max(1, *steps)]
    inputs: Inputs = {
        "colors": rng.random((3, *SIZE, 3)), "steps": np.array(steps, np.int32),
        "motions": np.broadcast_to(moves[:, None, None], (len(moves), *SIZE, 2)), "gbuffer": rng.random((*SIZE, 9)),
        "nov": rng.uniform(-1, 1, SIZE), "stencils": stencils, "normals": normals, "positions": positions,
    }  # fmt: skip
    return inputs, make_weights("random", 0, second)
