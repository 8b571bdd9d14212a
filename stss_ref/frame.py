# SPDX-License-Identifier: MIT
"""Stage frame: one display frame from its buffers to its image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stss_ref.arrays import Array, ArrayError, Image, Mask, Plane, require
from stss_ref.constants import HoleFill, HoleLimits, HoleTest
from stss_ref.detail import detail
from stss_ref.holes import holes
from stss_ref.motion_chain import chain_steps
from stss_ref.network import network
from stss_ref.occlusion_warp import occlusion_warp
from stss_ref.reshade import reshade
from stss_ref.warp import warp
from stss_ref.weights import SecondColor, Weights


@dataclass(frozen=True)
class FrameInputs:
    """The inputs of stage ``frame`` (spec 11), one dtype throughout.

    Attributes:
        colors: (3, H, W, 3) the three colour frames, newest first; display-referred, [0, 1].
        steps: the distance of each in display frames back; 0, 2, 4 for an SF; 1, 3, 5 for an EF. A step equal to the previous
            one stands for a missing frame (spec 1): its mask is 0.
        motions: (k, H, W, 2) of frames t, t-1, ...; k at least the largest step; pixels, current -> previous.
        gbuffer: (H, W, 9) normal 3, depth (normalised), roughness, metallic, base colour 3.
        nov: (H, W) dot of normal and view vector.
        stencils: (4, H, W); normals, positions: (4, H, W, 3); of the frame itself, then those of ``colors``; positions in cm.
    """

    colors: Array
    steps: tuple[int, int, int]
    motions: Array
    gbuffer: Image
    nov: Plane
    stencils: Array
    normals: Array
    positions: Array


@dataclass(frozen=True)
class NetworkInputs:
    """The inputs of stage ``network``: color (H, W, 6), gbuffer (H, W, 9), mask (H, W), history (3, H, W, 4)."""

    color: Image
    gbuffer: Image
    mask: Plane
    history: Array


def frame(inputs: FrameInputs, weights: Weights) -> tuple[Image, Mask]:
    """Compute one display frame: motion chain, warp, holes and their fill, network.

    Source: spec 1 to 8, 11; paper, Eq. 1.

    Args:
        inputs: the buffers.
        weights: the network's 92 tensors, with the second colour, hole test and hole fill of their training.

    Returns:
        image: (2H, 2W, 3), not clipped.
        valid: (H, W) False in the warping holes of the newest colour frame; all True for an SF.

    Raises:
        ArrayError: shapes or dtypes differ, or an array that must be finite is not.
    """
    prepared = prepare_for(weights, inputs)
    image = network(prepared.color, prepared.gbuffer, prepared.mask, prepared.history, weights)
    return image, prepared.mask.astype(bool)


def prepare_for(weights: Weights, inputs: FrameInputs) -> NetworkInputs:
    """The inputs of the network with these weights: ``prepare`` with their choices."""
    return prepare(inputs, weights.second_color, weights.hole_test, weights.hole_fill)


def prepare(
    inputs: FrameInputs,
    second: SecondColor = "newest",
    test: HoleTest = "footprint",
    hole_fill: HoleFill = "occlusion_warp",
    limits: HoleLimits | None = None,
) -> NetworkInputs:
    """Make the network's inputs: warp the three colour frames to the current one. Other arguments and errors as in ``frame``.

    ``color`` is two colours: the newest colour frame with its holes filled, and a second one. With ``second`` "newest" that is the same
    frame, its holes left as they are warped (spec 7); in an SF both are then the frame itself. With "detail" it is the
    detail of all warped frames (`detail`). ``test`` and ``limits``: see `holes`. ``hole_fill``: the stage that fills the holes.
    """
    _check(inputs)
    motions = motion_by_step(inputs.motions, inputs.steps)

    pairs = [warp_one(inputs, i, motions.get(step), test, limits) for i, step in enumerate(inputs.steps)]
    warped, valids = [w for w, _ in pairs], [valid for _, valid in pairs]
    color = two_colors(fill(inputs, warped[0], valids[0], motions.get(inputs.steps[0]), hole_fill), warped[0])
    if second == "detail":
        color[..., 3:] = detail_of(inputs, motions, inputs.colors, color[..., :3])
    return NetworkInputs(color, inputs.gbuffer, valids[0].astype(color.dtype), stack_history(warped, valids))


def detail_of(inputs: FrameInputs, motions: Mapping[int, Image], colors: Array, first: Image) -> Image:
    """The detail (H, W, 3) of three colour frames, warped by ``motions`` of `motion_by_step`, that ``first`` lacks (`detail`)."""
    moved = [i for i, step in enumerate(inputs.steps) if step in motions and not is_missing(inputs.steps, i)]
    return detail(first, inputs.stencils[0], [(colors[i], motions[inputs.steps[i]], inputs.stencils[i + 1]) for i in moved])


def motion_by_step(motions: Array, steps: Sequence[int]) -> dict[int, Image]:
    """The chained motion (H, W, 2) over each step that is not 0, by step."""
    chained = chain_steps(motions[: max(steps)]) if max(steps) > 0 else ()
    return {step: motion for step, motion in enumerate(chained, start=1) if step in steps}


def is_missing(steps: Sequence[int], i: int) -> bool:
    """Whether colour frame ``i`` stands for a missing one."""
    return i > 0 and steps[i] == steps[i - 1]


def warp_one(
    inputs: FrameInputs, i: int, motion: Image | None, test: HoleTest, limits: HoleLimits | None = None
) -> tuple[Image, Mask]:
    """Colour frame ``i`` warped to the current one, and True where to trust it: nowhere if it is missing.

    Without motion the frame itself, trusted everywhere.
    """
    if motion is None:
        return inputs.colors[i], np.full(inputs.nov.shape, not is_missing(inputs.steps, i))
    warped, _ = warp(inputs.colors[i], motion)
    valid = holes(
        motion,
        stencil_previous=inputs.stencils[i + 1],
        stencil=inputs.stencils[0],
        normal_previous=inputs.normals[i + 1],
        normal=inputs.normals[0],
        position_previous=inputs.positions[i + 1],
        position=inputs.positions[0],
        nov=inputs.nov,
        depth=inputs.gbuffer[..., 3],
        test=test,
        limits=limits,
    )
    return warped, valid & (not is_missing(inputs.steps, i))


def fill(inputs: FrameInputs, warped: Image, valid: Mask, motion: Image | None, by: HoleFill) -> Image:
    """The newest colour frame with its holes filled; without motion it has none."""
    if motion is None:
        return warped
    if by == "reshade":
        return reshade(
            inputs.colors[0],
            warped,
            motion,
            valid,
            stencil_previous=inputs.stencils[1],
            stencil=inputs.stencils[0],
            normal_previous=inputs.normals[1],
            normal=inputs.normals[0],
            position_previous=inputs.positions[1],
            position=inputs.positions[0],
            base_color=inputs.gbuffer[..., 6:9],
        )
    _, instead = occlusion_warp(inputs.colors[0], warped, motion, inputs.gbuffer[..., 3], valid)
    return instead


def two_colors(first: Image, second: Image) -> Image:
    """The network's colour (H, W, 6), at least 0."""
    return np.maximum(np.concatenate([first, second], axis=-1), 0)


def stack_history(warped: Sequence[Image], valids: Sequence[Mask]) -> Array:
    """The network's history (3, H, W, 4), oldest first: colours, at least 0, and where to trust them."""
    masks = [valid[..., None].astype(w.dtype) for w, valid in zip(warped, valids, strict=True)]
    return np.stack([np.concatenate([np.maximum(w, 0), m], axis=-1) for w, m in zip(warped, masks, strict=True)][::-1])


def _check(inputs: FrameInputs) -> None:
    count = 0 if np.shape(inputs.motions)[:1] == (0,) else "k"  # a first frame needs no motion
    require(
        {
            "gbuffer": (inputs.gbuffer, "H, W, 9"), "colors": (inputs.colors, "3, H, W, 3"),
            "motions": (inputs.motions, f"{count}, H, W, 2"),
            "nov": (inputs.nov, "H, W"), "stencils": (inputs.stencils, "4, H, W"), "normals": (inputs.normals, "4, H, W, 3"),
            "positions": (inputs.positions, "4, H, W, 3"),
        },
        non_finite=["motions", "positions"],
    )  # fmt: skip
    if len(inputs.steps) != 3 or list(inputs.steps) != sorted(inputs.steps) or inputs.steps[0] < 0:
        raise ArrayError(f"steps: expected three numbers >= 0, newest (smallest) first, got {tuple(inputs.steps)}")
    if len(inputs.motions) < max(inputs.steps):
        _, *size = inputs.motions.shape
        raise ArrayError(
            f"motions: expected (k, {', '.join(map(str, size))}) with k >= {max(inputs.steps)}, got {inputs.motions.shape}"
        )
