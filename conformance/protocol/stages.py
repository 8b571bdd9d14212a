# SPDX-License-Identifier: MIT
"""The stages of the port protocol (spec 11): the inputs and outputs of each, and the reference that computes it.

``"3 H W 4"`` is an array of floats, ``"H W uint8"`` a mask of 0 and 1, ``"4 int"`` are integers. A letter stands for any size of at
least 1, the same in all arrays of the stage; ``H/8`` says that H is a multiple of 8.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.protocol.array_specs import (
    ArraySpec,
    Label,
    Sizes,
    array_spec,
    check_numbers,
    check_shapes,
    require_multiples,
)
from conformance.protocol.port import Arrays, Outputs
from stss_ref.accumulate import accumulate
from stss_ref.arrays import ArrayError
from stss_ref.constants import HoleTest
from stss_ref.decoder import decoder
from stss_ref.encoder import encoder
from stss_ref.erm import erm
from stss_ref.frame import FrameInputs, frame, prepare_for
from stss_ref.history import history_embedding
from stss_ref.holes import holes
from stss_ref.motion_chain import motion_chain
from stss_ref.network import network
from stss_ref.occlusion_warp import occlusion_warp
from stss_ref.reshade import reshade
from stss_ref.rrm import rrm
from stss_ref.warp import warp
from stss_ref.weights import Weights, astype


@dataclass(frozen=True)
class Stage:
    """One row of the table.

    Attributes:
        name: the stage's word.
        inputs: its inputs, in the order in which sizes become known.
        outputs: its outputs.
        weights: whether it takes the network's weights.
        compute: the reference: takes inputs and weights (in one dtype; empty for a stage that takes none), returns outputs.
    """

    name: str
    inputs: Mapping[str, ArraySpec]
    outputs: Mapping[str, ArraySpec]
    weights: bool
    compute: Callable[[Arrays, Weights], Outputs]


def _stage(
    name: str,
    inputs: Mapping[str, str],
    outputs: Mapping[str, str],
    compute: Callable[[Arrays, Weights], Outputs],
    *,
    weights: bool = False,
) -> Stage:
    input_specs = {key: array_spec(text) for key, text in inputs.items()}
    output_specs = {key: array_spec(text) for key, text in outputs.items()}
    return Stage(name, input_specs, output_specs, weights, compute)


def _warp(a: Arrays, _: Weights) -> Outputs:
    warped, inside = warp(**a)
    return {"warped": warped, "inside": inside}


def hole_test(paper: NDArray[Any]) -> HoleTest:
    """The hole test by the input ``paper`` of stage ``holes``: the footprint's for 0, otherwise the paper's."""
    return "paper" if paper[0] else "footprint"


def _holes(a: Arrays, _: Weights) -> Outputs:
    planes = {name: array for name, array in a.items() if name != "paper"}
    return {"valid": holes(**planes, test=hole_test(a["paper"]), limits=None)}


def _occlusion_warp(a: Arrays, _: Weights) -> Outputs:
    occlusion_motion, image = occlusion_warp(**a)
    return {"occlusion_motion": occlusion_motion, "occlusion_warp": image}


def _rrm(a: Arrays, _: Weights) -> Outputs:
    y, x, height, width = (int(n) for n in a["rectangle"])
    return {"valid": rrm(a["valid"], (y, x, height, width))}


def _frame_inputs(a: Arrays) -> FrameInputs:
    newest, middle, oldest = (int(n) for n in a["steps"])
    return FrameInputs(**{name: array for name, array in a.items() if name != "steps"}, steps=(newest, middle, oldest))


def network_inputs(a: Arrays, weights: Weights) -> Outputs:
    """The inputs of stage ``network`` that stage ``frame`` makes from its own."""
    prepared = prepare_for(weights, _frame_inputs(a))
    return {"color": prepared.color, "gbuffer": prepared.gbuffer, "mask": prepared.mask, "history": prepared.history}


_ROWS = (
    _stage("motion_chain", {"motions": "k H W 2"}, {"motion": "H W 2"}, lambda a, _: {"motion": motion_chain(a["motions"])}),
    _stage("warp", {"color": "H W C", "motion": "H W 2"}, {"warped": "H W C", "inside": "H W uint8"}, _warp),
    _stage(
        "holes",
        {
            "motion": "H W 2",
            "stencil_previous": "H W",
            "stencil": "H W",
            "normal_previous": "H W 3",
            "normal": "H W 3",
            "position_previous": "H W 3",
            "position": "H W 3",
            "nov": "H W",
            "depth": "H W",
            "paper": "1 int",
        },
        {"valid": "H W uint8"},
        _holes,
    ),
    _stage(
        "occlusion_warp",
        {"color": "H W 3", "warped": "H W 3", "motion": "H W 2", "depth": "H W", "valid": "H W uint8"},
        {"occlusion_motion": "H W 2", "occlusion_warp": "H W 3"},
        _occlusion_warp,
    ),
    _stage(
        "reshade",
        {
            "color": "H W 3",
            "warped": "H W 3",
            "motion": "H W 2",
            "valid": "H W uint8",
            "stencil_previous": "H W",
            "stencil": "H W",
            "normal_previous": "H W 3",
            "normal": "H W 3",
            "position_previous": "H W 3",
            "position": "H W 3",
            "base_color": "H W 3",
        },
        {"reshade": "H W 3"},
        lambda a, _: {"reshade": reshade(**a)},
    ),
    _stage("rrm", {"valid": "H W uint8", "rectangle": "4 int"}, {"valid": "H W uint8"}, _rrm),
    _stage(
        "history",
        {"history": "3 H W 4"},
        {"feature": "H/8 W/8 32"},
        lambda a, weights: {"feature": history_embedding(a["history"], weights)},
        weights=True,
    ),
    _stage(
        "encoder",
        {"color": "H W 6", "gbuffer": "H W 9", "mask": "H W"},
        {"x1": "H W 24", "x2": "H/2 W/2 24", "x3": "H/4 W/4 32", "x4": "H/8 W/8 32"},
        lambda a, weights: dict(zip(("x1", "x2", "x3", "x4"), encoder(**a, weights=weights), strict=True)),
        weights=True,
    ),
    _stage(
        "erm",
        {"x4": "H/8 W/8 32", "gbuffer": "H W 9", "mask": "H W"},
        {"reshaded": "H/8 W/8 64"},
        lambda a, weights: {"reshaded": erm(**a, weights=weights)},
        weights=True,
    ),
    _stage(
        "decoder",
        {
            "reshaded": "H/8 W/8 64",
            "feature": "H/8 W/8 32",
            "x1": "H W 24",
            "x2": "H/2 W/2 24",
            "x3": "H/4 W/4 32",
            "color": "H W 6",
        },
        {"image": "2H 2W 3"},
        lambda a, weights: {"image": decoder(**a, weights=weights)},
        weights=True,
    ),
    _stage(
        "network",
        {"color": "H W 6", "gbuffer": "H W 9", "mask": "H W", "history": "3 H W 4"},
        {"image": "2H 2W 3"},
        lambda a, weights: {"image": network(**a, weights=weights)},
        weights=True,
    ),
    _stage(
        "frame",
        {
            "colors": "3 H W 3",
            "steps": "3 int",
            "motions": "k H W 2",
            "gbuffer": "H W 9",
            "nov": "H W",
            "stencils": "4 H W",
            "normals": "4 H W 3",
            "positions": "4 H W 3",
        },
        {"image": "2H 2W 3"},
        lambda a, weights: {"image": frame(_frame_inputs(a), weights)[0]},
        weights=True,
    ),
    _stage(
        "accumulate",
        {"image": "2H 2W 3", "earlier": "k 2H 2W 3", "motions": "k H W 2"},
        {"shown": "2H 2W 3"},
        lambda a, _: {"shown": accumulate(**a)},
    ),
)

STAGES: Mapping[str, Stage] = {row.name: row for row in _ROWS}
"""Every stage of the protocol by its name, in the order of the pipeline."""


def find(name: str) -> Stage:
    """The row of this name; ArrayError if there is none."""
    if name not in STAGES:
        raise ArrayError(f"stage: expected one of {', '.join(STAGES)}, got {name!r}")
    return STAGES[name]


def check_inputs(stage: str, inputs: Arrays, dtype: str | None = None, label: Label = str) -> Sizes:
    """Check that ``inputs`` are a stage's inputs.

    Args:
        stage: its name.
        inputs: arrays by the names of the table.
        dtype: the dtype of all floats; None: float32 or float64, the same in all of them.
        label: turns an array's name into the name that an error shows.

    Returns:
        The size of each letter.

    Raises:
        ArrayError: an array is missing, not the stage's, misshapen, of another dtype, or a mask with other values than 0 and 1.
    """
    sizes = check_input_shapes(stage, inputs, dtype, label)
    check_numbers(find(stage).inputs, inputs, label)
    return sizes


def check_input_shapes(stage: str, inputs: Arrays, dtype: str | None = None, label: Label = str) -> Sizes:
    """Check shapes and dtypes only, as of files whose numbers are not yet read."""
    row = find(stage)
    require_inputs(stage, inputs, label)
    sizes = check_shapes(row.inputs, inputs, {}, dtype, label)
    require_multiples(row.inputs, row.outputs, sizes, label)
    return sizes


def require_inputs(stage: str, names: Iterable[str], label: Label = str) -> None:
    """Raise ArrayError if a name is not one of the stage's inputs."""
    specs = find(stage).inputs
    for name in names:
        if name not in specs:
            raise ArrayError(f"{label(name)}: not an input of stage {stage} ({', '.join(specs)})")


def check_outputs(stage: str, outputs: Arrays, sizes: Sizes, dtype: str = "float32", label: Label = str) -> None:
    """Check that ``outputs`` are a stage's outputs for inputs of these sizes; NaN is left to the judge. Errors as above."""
    check_output_shapes(stage, outputs, sizes, dtype, label)
    check_numbers(find(stage).outputs, outputs, label)


def check_output_shapes(stage: str, outputs: Arrays, sizes: Sizes, dtype: str = "float32", label: Label = str) -> None:
    """Check shapes and dtypes of outputs only, as `check_input_shapes` does of inputs."""
    check_shapes(find(stage).outputs, outputs, sizes, dtype, label)


def reference(stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
    """Compute a stage by the reference, in the dtype of the inputs: float64 is the truth.

    Args:
        stage: its name.
        inputs: see `check_inputs`.
        weights: the network's tensors, of any dtype; needed by the stages that take them.

    Raises:
        ArrayError: inputs or weights do not fit the stage.
    """
    row = find(stage)
    check_inputs(stage, inputs)
    if row.weights and weights is None:
        raise ArrayError(f"weights: missing; stage {stage} takes them")

    cast = Weights({})
    if row.weights and weights is not None:
        cast = astype(weights, next(inputs[name].dtype for name, spec in row.inputs.items() if spec.kind == "float"))
    outputs = row.compute(inputs, cast)
    kinds = {name: np.uint8 if spec.kind == "uint8" else None for name, spec in row.outputs.items()}
    return {name: np.array(outputs[name], kind, order="C") for name, kind in kinds.items()}
