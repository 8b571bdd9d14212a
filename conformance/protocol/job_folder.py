# SPDX-License-Identifier: MIT
"""Read and write the job folder of spec 11: the inputs of a port that is a program, and the outputs that it leaves.

``JOB/0000/stage``, ``JOB/0000/in/NAME.npy``, ``JOB/0000/in/weights.safetensors``; then ``JOB/0000/out/NAME.npy`` or an empty file
``JOB/0000/unsupported``. A job may come from anybody: it is refused unless it is a tree of real files, and shapes and sizes are checked
against the stage before memory is allocated.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO

import numpy as np
import safetensors
from safetensors.numpy import save

from conformance.protocol.array_specs import ArraySpec, Sizes, check_numbers
from conformance.protocol.job_tree import Folder, JobError
from conformance.protocol.layers import LAYERS_OF, check_layers
from conformance.protocol.npy import Claim, read_claim, read_numbers, write_array
from conformance.protocol.port import AnyArray, Arrays, Case, Outputs, Unsupported
from conformance.protocol.stages import check_input_shapes, check_inputs, check_output_shapes, find, require_inputs
from stss_ref.arrays import ArrayError
from stss_ref.weights import Weights, WeightsError, check, format_metadata, take_second_color

LAYERS = "layers"
"""Folder of a case for the outputs of layers inside its stage; the judge makes it to ask for them."""
WEIGHTS = "weights.safetensors"
DTYPE = "float32"
"""The dtype of every float in a job, whatever the port's arithmetic."""
MOST_CASES = 100_000
"""Most cases of a job."""
MOST_BYTES = 2 * 2**30
"""Most bytes of a case's inputs; stage frame for an image of 7680 x 4320 has 1.9 GiB."""
MOST_WEIGHTS_BYTES = 64 * 2**20
"""Most bytes of a weights file; this network's has 1.7 MiB."""


def write_job(job: Path, cases: Sequence[Case], first: int = 0, *, layers: bool = False) -> None:
    """Write ``cases`` into the folder ``job``, which is made if need be.

    Args:
        job: the folder.
        cases: the cases.
        first: number of the first case.
        layers: whether to ask for the outputs of layers inside the stages.

    Raises:
        ArrayError: inputs are not those of the stage.
        WeightsError: weights are not of this network, or not float32.
    """
    written: dict[int, Path] = {}
    for number, case in enumerate(cases, first):
        folder = job / f"{number:04d}"
        check_inputs(case.stage, case.inputs, DTYPE)
        (folder / "in").mkdir(parents=True)
        (folder / "stage").write_text(f"{case.stage}\n", encoding="ascii")
        if layers:
            (folder / LAYERS).mkdir()
        for name, array in case.inputs.items():
            with (folder / "in" / f"{name}.npy").open("xb") as file:
                write_array(name, file, array)
        if not find(case.stage).weights:
            continue
        if case.weights is None:
            raise ArrayError(f"weights: missing; stage {case.stage} takes them")
        path = folder / "in" / WEIGHTS
        if id(case.weights) in written:
            link(written[id(case.weights)], path)
        else:
            path.write_bytes(_serialised(case.weights))
            written[id(case.weights)] = path


def _serialised(weights: Weights) -> bytes:
    return save({name: np.ascontiguousarray(tensor) for name, tensor in check(weights).items()}, format_metadata(weights))


def link(source: Path, path: Path) -> None:
    """Give the same 1.7 MB a second name; copy them where the file system has no links."""
    try:
        os.link(source, path)
    except OSError:
        shutil.copyfile(source, path)


def case_names(job: Folder) -> list[str]:
    """Names of the folders of a job's cases, in order; other files beside them are ignored.

    Raises:
        JobError: there is no case, there are more than ``MOST_CASES``, or one is a link.
    """
    numbered = [name for name in job.names() if re.fullmatch(r"[0-9]{4,9}", name) and job.kind(name) != "file"]
    if not numbered:
        raise JobError(f"{job.path}: no case in it; the first is a folder named 0000")
    if len(numbered) > MOST_CASES:
        raise JobError(f"{job.path}: expected up to {MOST_CASES} cases, got {len(numbered)}")
    for name in numbered:
        job.require(name, "folder")
    return sorted(numbered, key=int)


def read_stage(case: Folder) -> str:
    """The case's stage, which need not be in the table: a later version of the project may have more."""
    with case.file("stage") as file:
        text = file.read(100)
    if not re.fullmatch(rb"[a-z0-9_]{1,64}\s*", text):
        raise JobError(f"{case.path / 'stage'}: expected one line, the name of a stage, got {text[:40]!r}")
    return text.decode().strip()


def read_inputs(case: Folder, stage: str) -> Outputs:
    """Read the arrays of ``case/in``, checked against the table.

    Raises:
        JobError: an array is missing, damaged, of another stage, or not as the table says; or together they exceed ``MOST_BYTES``.
    """
    taken = find(stage).inputs
    with case.folder("in") as folder:
        # Hidden files are those of file managers.
        found = [name.removesuffix(".npy") for name in folder.names() if name.endswith(".npy") and not name.startswith(".")]

        def fits(claims: Mapping[str, Claim]) -> None:
            check_input_shapes(stage, claims, DTYPE, label)
            if sum(claim.nbytes for claim in claims.values()) > MOST_BYTES:
                largest = max(claims, key=lambda name: claims[name].nbytes)
                raise ArrayError(f"{label(largest)}: expected inputs of up to {MOST_BYTES >> 30} GiB in a case")

        def label(name: str) -> str:
            return f"{folder.path / name}.npy"

        try:
            require_inputs(stage, found, label)
            return _read_arrays(folder, taken, fits)
        except ArrayError as error:
            raise JobError(str(error)) from error


def read_weights(data: bytes, path: Path) -> Weights:
    """Read the tensors of a job's weights file.

    Args:
        data: all of its bytes.
        path: for messages.

    Raises:
        JobError: it is damaged, of another version, or a tensor is not what the network takes.
    """
    try:
        tensors = dict(safetensors.deserialize(data))
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        second = take_second_color(dict(header.get("__metadata__", {})))
        for name, tensor in tensors.items():
            if tensor["dtype"] != "F32":
                raise JobError(f"{path}: {name[:80]}: expected dtype F32, got {tensor['dtype']}")
        arrays = {
            name: np.frombuffer(tensor["data"], "<f4").astype(np.float32).reshape(tensor["shape"])
            for name, tensor in tensors.items()
        }
        return check(arrays, second)
    except WeightsError as error:
        raise JobError(f"{path}: {error}") from error
    except (safetensors.SafetensorError, ValueError) as error:
        if isinstance(error, JobError):
            raise
        raise JobError(f"{path}: damaged safetensors file ({error})") from error


def clear(case: Folder) -> None:
    """Remove the outputs of an earlier run, so that results of two runs are never mixed.

    Raises:
        JobError: something there is not a real file; then nothing was removed.
    """
    if case.kind("unsupported") is not None:
        case.require("unsupported", "file")
    for folder in (kept for kept in ("out", LAYERS) if case.kind(kept) is not None):
        with case.folder(folder) as out:
            old = [name for name in out.names() if name.endswith(".npy")]
            for name in old:
                out.require(name, "file")
            for name in old:
                out.remove(name)
    case.remove("unsupported")


def write_outputs(case: Folder, outputs: Arrays, into: str = "out") -> None:
    """Write ``case/out``, or layers into ``case/layers``; a file is there only when it is whole."""
    with case.made(into) as out:
        for name, array in outputs.items():
            with out.written(f"{name}.npy") as file:
                write_array(name, file, array)


def write_unsupported(case: Folder) -> None:
    """Write the file that says that the port lacks the stage."""
    with case.written("unsupported"):
        pass


def read_outputs(case: Folder, stage: str, sizes: Sizes) -> Outputs | Unsupported:
    """Read the outputs that a program left in ``case``; files that the table does not name are ignored.

    Args:
        case: the case's folder.
        stage: the stage's name.
        sizes: the result of `check_inputs` for its inputs.

    Raises:
        JobError: an output is missing, damaged, not a real file, or not as the table says.
    """
    given = find(stage).outputs
    unsupported = case.kind("unsupported") is not None
    if unsupported:
        case.require("unsupported", "file")
    if case.kind("out") is None:
        if unsupported:
            return Unsupported(stage)
        raise JobError(f"{case.path / 'out' / next(iter(given))}.npy: missing")
    with case.folder("out") as out:
        there = [name for name in given if out.kind(f"{name}.npy") is not None]
        if unsupported and there:
            claimed = case.path / "unsupported"
            raise JobError(f"{out.path / there[0]}.npy: written, although {claimed} says that there is no such stage")
        if unsupported:
            return Unsupported(stage)

        def label(name: str) -> str:
            return f"{out.path / name}.npy"

        try:
            return _read_arrays(out, given, lambda claims: check_output_shapes(stage, claims, sizes, DTYPE, label))
        except ArrayError as error:
            raise JobError(str(error)) from error


def read_layers(case: Folder, stage: str, inputs: Arrays) -> Outputs:
    """Read the layers that a program left: all, some or none.

    Raises:
        JobError: a file is not a layer of the stage, is damaged, not a real file, or misshapen.
    """
    if case.kind(LAYERS) is None:
        return {}
    with case.folder(LAYERS) as folder:
        found = [name.removesuffix(".npy") for name in folder.names() if name.endswith(".npy") and not name.startswith(".")]

        def label(name: str) -> str:
            return f"{folder.path / name}.npy"

        try:
            specs = LAYERS_OF.get(stage, {})
            if unknown := [name for name in found if name not in specs]:
                raise ArrayError(f"{label(unknown[0])}: not a layer of stage {stage}")
            some = {name: specs[name] for name in specs if name in found}
            return _read_arrays(folder, some, lambda claims: check_layers(stage, claims, inputs, label))
        except ArrayError as error:
            raise JobError(str(error)) from error


def read_array(folder: Folder, name: str) -> AnyArray:
    """Read one array of numbers; the result is C-contiguous in the machine's byte order.

    Raises:
        JobError: it is missing, it is an array of objects, its size does not fit its header, or it exceeds ``MOST_BYTES``.
    """
    path = folder.path / name
    with folder.file(name) as file:
        claim = read_claim(path, file)
        if claim.nbytes > MOST_BYTES:
            raise JobError(f"{path}: expected up to {MOST_BYTES >> 30} GiB")
        return read_numbers(path, file, claim)


def _read_arrays(folder: Folder, specs: Mapping[str, ArraySpec], fits: Callable[[Mapping[str, Claim]], None]) -> Outputs:
    """The arrays of these names; ``fits`` is asked before the first number is read. It raises ArrayError."""
    with ExitStack() as opened:
        paths = {name: folder.path / f"{name}.npy" for name in specs}
        files: dict[str, BinaryIO] = {name: opened.enter_context(folder.file(path.name)) for name, path in paths.items()}
        claims = {name: read_claim(paths[name], file) for name, file in files.items()}
        fits(claims)
        arrays = {name: read_numbers(paths[name], file, claims[name]) for name, file in files.items()}
    check_numbers(specs, arrays, lambda name: str(paths[name]))
    return arrays
