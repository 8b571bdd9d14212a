# SPDX-License-Identifier: MIT
"""Cases of any network: its inputs, drawn by Hypothesis from their types and shapes, or given as files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from conformance.graph.model import Input, Model
from conformance.graph.rounding import AnyArray
from conformance.protocol.drawn_case import CASES_FOLDER, read_drawn
from conformance.protocol.job_folder import JobError, read_array
from stss_ground.errors import InputError

KINDS = ("uniform", "normal", "ramp", "zeros", "border", "impulse", "checker", "large", "small", "halves")
"""The content of inputs. ``border``: the first and last two of each axis alone; ``halves``: numbers that half precision has."""
SIZES = (32, 64, 8, 16, 24, 40, 96)
"""Sizes of axes that the model leaves open."""
BATCHES = (1, 2)


@dataclass(frozen=True)
class GraphCase:
    """One call: the sizes of open axes, the kind of inputs, and a seed."""

    sizes: Mapping[str, int]
    kind: str
    seed: int

    def inputs(self, model: Model) -> dict[str, AnyArray]:
        """The arrays."""
        random = np.random.default_rng(self.seed)
        shapes = [[self.sizes[n] if isinstance(n, str) else n for n in each.shape] for each in model.inputs]
        return {each.name: _array(each, shape, self.kind, random) for each, shape in zip(model.inputs, shapes, strict=True)}

    def __str__(self) -> str:
        sizes = ", ".join(f"{name} {n}" for name, n in self.sizes.items())
        return f"{self.kind}, seed {self.seed}{', ' + sizes if sizes else ''}"


def cases(model: Model, fixed: Mapping[str, int]) -> st.SearchStrategy[GraphCase]:
    """Calls of a model; ``fixed``: the sizes of open axes that are not drawn."""
    open_ = {str(n): i for each in model.inputs for i, n in enumerate(each.shape) if isinstance(n, str)}
    sizes = {
        name: st.just(fixed[name]) if name in fixed else st.sampled_from(BATCHES if axis == 0 else SIZES)
        for name, axis in open_.items()
    }
    return st.builds(GraphCase, st.fixed_dictionaries(sizes), st.sampled_from(KINDS), st.integers(0, 2**16))


def read_case(model: Model, files: Sequence[str]) -> dict[str, AnyArray]:
    """Inputs from ``NAME=FILE.npy``, checked against the model.

    Raises:
        InputError: a file is missing or damaged, or does not fit.
    """
    paths: dict[str, str] = {name: file for name, _, file in (each.partition("=") for each in files)}
    try:
        arrays = {name: read_array(Path(file)) for name, file in paths.items()}
    except JobError as error:
        raise InputError(f"--input: {error}") from error
    return _fitting(model, arrays, "--input")


def read_failure(model: Model, folder: Path) -> list[dict[str, AnyArray]]:
    """The inputs of a failure's folder, those before the failing ones first, checked against the model.

    Raises:
        InputError: it is not the folder of a failure of this model.
    """
    try:
        _, case = read_drawn(folder / CASES_FOLDER)
    except JobError as error:
        raise InputError(f"{folder}: expected the folder of one failure: {error}") from error
    whole: Any = case
    if not isinstance(whole, list) or not whole or not all(isinstance(each, dict) for each in whole):
        raise InputError(f"{folder}: expected the folder of a network's failure")
    return [_fitting(model, each, str(folder)) for each in whole]


def _fitting(model: Model, arrays: Mapping[str, Any], where: str) -> dict[str, AnyArray]:
    """The arrays in the order of the model's inputs; InputError unless they fit it."""
    names = [each.name for each in model.inputs]
    if unknown := arrays.keys() - {*names}:
        raise InputError(f"{where}: expected {', '.join(names)}, got {min(unknown)}")
    for each in model.inputs:
        array = arrays.get(each.name)
        if not isinstance(array, np.ndarray):
            raise InputError(f"{where}: {each.name} is missing")
        fits = len(array.shape) == len(each.shape) and all(
            isinstance(n, str) or n == m for n, m in zip(each.shape, array.shape, strict=True)
        )
        if array.dtype != each.dtype or not fits:
            shape = ", ".join(map(str, each.shape))
            raise InputError(f"{where}: {each.name}: expected {each.dtype} ({shape}), found {array.dtype} {array.shape}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputError(f"{where}: {each.name}: expected finite numbers")
    return {name: arrays[name] for name in names}


def _array(source: Input, shape: Sequence[int], kind: str, random: np.random.Generator) -> AnyArray:
    if source.dtype == "bool":
        return random.random(shape) < 0.5
    if source.dtype not in ("float16", "float32", "float64"):
        return random.integers(0, 4, shape).astype(source.dtype)
    x = random.random(shape)
    if kind == "normal":
        x = random.standard_normal(shape)
    elif kind in ("large", "small"):
        x = random.standard_normal(shape) * (100 if kind == "large" else 1e-4)
    elif kind == "zeros":
        x = x * 0
    elif kind == "ramp":
        x = np.indices(shape).sum(axis=0) / max(sum(shape), 1)
    elif kind == "checker":
        x = np.indices(shape).sum(axis=0) % 2.0
    elif kind == "border":
        inside = tuple(slice(2, -2) if n > 4 else slice(0, 0) for n in shape[2:])
        x[(..., *inside)] = 0
    elif kind == "impulse":
        lit = np.zeros_like(x)
        lit.flat[int(random.integers(max(lit.size, 1)))] = 1
        x = lit
    return (x.astype(np.float16) if kind == "halves" else x).astype(source.dtype)
