# SPDX-License-Identifier: MIT
"""The job folder of spec 11, read and written: what a port that is a program is handed, and what it leaves.

``JOB/0000/stage``, ``JOB/0000/in/NAME.npy``, ``JOB/0000/in/weights.safetensors``; then ``JOB/0000/out/NAME.npy`` or an empty file
``JOB/0000/unsupported``. Nothing that is read is executed, and no memory is taken for numbers that a file only claims to have.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from safetensors.numpy import save

from conformance.protocol.array_specs import Sizes
from conformance.protocol.port import AnyArray, Arrays, Case, Outputs, Unsupported
from conformance.protocol.stages import check_inputs, check_outputs, find
from stss_ref.arrays import ArrayError
from stss_ref.weights import Weights, check

WEIGHTS = "weights.safetensors"
WEIGHTS_METADATA = {"stss_weights_version": "1"}
DTYPE = "float32"
"""Of every float in a job, whatever a port computes in."""


class JobError(ValueError):
    """A job folder is not what it must be; the message names the file, what was expected and what was found."""


def write_job(job: Path, cases: Sequence[Case]) -> None:
    """Write ``cases`` into the folder ``job``, which is made if need be.

    Raises:
        ArrayError: inputs are not what a stage takes.
        WeightsError: weights are not of this network, or not float32.
    """
    written: dict[int, Path] = {}
    for number, case in enumerate(cases):
        folder = job / f"{number:04d}"
        check_inputs(case.stage, case.inputs, DTYPE)
        (folder / "in").mkdir(parents=True)
        (folder / "stage").write_text(f"{case.stage}\n", encoding="ascii")
        for name, array in case.inputs.items():
            _write_array(folder / "in" / f"{name}.npy", array)
        if not find(case.stage).weights:
            continue
        if case.weights is None:
            raise ArrayError(f"weights: missing; stage {case.stage} takes them")
        path = folder / "in" / WEIGHTS
        if id(case.weights) in written:
            _link(written[id(case.weights)], path)
        else:
            path.write_bytes(_serialised(case.weights))
            written[id(case.weights)] = path


def _serialised(weights: Weights) -> bytes:
    return save({name: np.ascontiguousarray(tensor) for name, tensor in check(weights).items()}, WEIGHTS_METADATA)


def _link(source: Path, path: Path) -> None:
    """The same 1.7 MB under a second name; copied where the file system has no links."""
    try:
        os.link(source, path)
    except OSError:
        shutil.copyfile(source, path)


def case_folders(job: Path) -> list[Path]:
    """The folders of a job's cases, in order; other files beside them do not matter."""
    if not job.is_dir():
        raise JobError(f"{job}: no such folder")
    folders = [path for path in job.iterdir() if re.fullmatch(r"[0-9]{4,9}", path.name) and path.is_dir()]
    if not folders:
        raise JobError(f"{job}: no case in it; the first is a folder named 0000")
    return sorted(folders, key=lambda path: int(path.name))


def read_stage(case: Path) -> str:
    """The case's stage, which need not be in the table: a later version of the project may have more."""
    path = case / "stage"
    _require_file(path)
    with path.open("rb") as file:
        text = file.read(100)
    if not re.fullmatch(rb"[a-z0-9_]{1,64}\s*", text):
        raise JobError(f"{path}: expected one line, the name of a stage, got {text[:40]!r}")
    return text.decode().strip()


def read_inputs(case: Path, stage: str) -> Outputs:
    """The arrays of ``case/in``, checked against the table.

    Raises:
        JobError: one is missing, damaged, of another stage, or not what the stage takes.
    """
    folder = case / "in"
    if not folder.is_dir():
        raise JobError(f"{folder}: no such folder")
    taken = find(stage).inputs
    for path in sorted(folder.glob("*.npy")):
        # Hidden files are those of file managers.
        if path.stem not in taken and not path.name.startswith("."):
            raise JobError(f"{path}: not an input of stage {stage} ({', '.join(taken)})")
    inputs = {name: read_array(folder / f"{name}.npy") for name in taken}
    try:
        check_inputs(stage, inputs, DTYPE, label=lambda name: f"{folder / name}.npy")
    except ArrayError as error:
        raise JobError(str(error)) from error
    return inputs


def clear(case: Path) -> None:
    """Remove what an earlier run left, so that results of two runs never stand side by side."""
    (case / "unsupported").unlink(missing_ok=True)
    for path in (case / "out").glob("*.npy"):
        path.unlink()


def write_outputs(case: Path, outputs: Arrays) -> None:
    """Write ``case/out``; a file is there only when it is whole."""
    (case / "out").mkdir(exist_ok=True)
    for name, array in outputs.items():
        _write_array(case / "out" / f"{name}.npy", array)


def write_unsupported(case: Path) -> None:
    """Say that the stage is not there."""
    (case / "unsupported").touch()


def read_outputs(case: Path, stage: str, sizes: Sizes) -> Outputs | Unsupported:
    """What a program left in ``case``; files that the table does not name are not looked at.

    Args:
        case: its folder.
        stage: its name.
        sizes: what `check_inputs` said of its inputs.

    Raises:
        JobError: an output is missing, damaged, or not what the stage gives.
    """
    paths = {name: case / "out" / f"{name}.npy" for name in find(stage).outputs}
    if (case / "unsupported").exists():
        if there := [path for path in paths.values() if path.exists()]:
            raise JobError(f"{there[0]}: written, although {case / 'unsupported'} says that there is no such stage")
        return Unsupported(stage)
    outputs = {name: read_array(path) for name, path in paths.items()}
    try:
        check_outputs(stage, outputs, sizes, DTYPE, label=lambda name: str(paths[name]))
    except ArrayError as error:
        raise JobError(str(error)) from error
    return outputs


def read_array(path: Path) -> AnyArray:
    """One plain array of numbers, in the machine's byte order and C-contiguous, whatever it was in the file.

    Raises:
        JobError: there is none, or it is of objects, or its size is not what its header says.
    """
    _require_file(path)
    with path.open("rb") as file:
        shape, fortran, dtype = _header(path, file)
        count = prod(shape)
        expected, got = file.tell() + count * dtype.itemsize, os.fstat(file.fileno()).st_size
        if expected != got:
            raise JobError(f"{path}: expected {expected} bytes for {dtype} of shape {_short(shape)}, got {got}")
        numbers = np.fromfile(file, dtype, count)
    array = numbers.reshape(shape[::-1]).T if fortran else numbers.reshape(shape)
    return array.astype(dtype.newbyteorder("="), order="C", copy=False)


def _header(path: Path, file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether in Fortran's order, and dtype."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        version = np.lib.format.read_magic(file)
        shape, fortran, dtype = readers[version](file)
    except KeyError as error:
        raise JobError(f"{path}: expected version 1.0 or 2.0 of the .npy format, got {_short(error)}") from error
    except Exception as error:
        # A stranger's text, which NumPy evaluates as a literal: more than ValueError comes out.
        raise JobError(f"{path}: not a .npy file: {_short(error)}") from error
    if dtype.hasobject:
        raise JobError(f"{path}: an array of objects, which only executing it could read; expected numbers")
    if dtype.kind not in "biuf" or dtype.subdtype is not None:
        raise JobError(f"{path}: expected an array of numbers, got {_short(dtype)}")
    if any(n < 0 for n in shape):
        raise JobError(f"{path}: a negative size in its shape {_short(shape)}")
    return shape, fortran, dtype


def _short(value: object) -> str:
    """The first line of its text, cut off."""
    lines = str(value).splitlines()
    return lines[0][:100] if lines else type(value).__name__


def _require_file(path: Path) -> None:
    # A pipe or a device would block, or never end.
    if not path.is_file():
        raise JobError(f"{path}: {'not a file' if path.exists() else 'missing'}")


def _write_array(path: Path, array: AnyArray) -> None:
    """Version 1.0, little-endian, C order; integers as int32."""
    narrow = array.astype(np.int32) if array.dtype.kind in "iu" and array.dtype != np.uint8 else array
    if narrow is not array and (narrow != array).any():
        raise ArrayError(f"{path.stem}: expected integers of 32 bits")
    plain = narrow.astype(narrow.dtype.newbyteorder("<"), order="C", copy=False)
    with _replacing(path) as file:
        np.lib.format.write_array(file, plain, version=(1, 0), allow_pickle=False)


@contextmanager
def _replacing(path: Path) -> Generator[BinaryIO, None, None]:
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
