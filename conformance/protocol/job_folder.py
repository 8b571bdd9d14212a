# SPDX-License-Identifier: MIT
"""Read and write the job folder of spec 11: the inputs of a port that is a program, and the outputs that it leaves.

``JOB/0000/stage``, ``JOB/0000/in/NAME.npy``, ``JOB/0000/in/weights.safetensors``; then ``JOB/0000/out/NAME.npy`` or an empty file
``JOB/0000/unsupported``. A job may come from anybody: it is refused if it has links, and shapes and sizes are checked against the stage
before numbers are read.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Literal
from urllib.parse import quote

import numpy as np
import safetensors

from conformance.protocol.array_specs import ArraySpec, Sizes, check_numbers
from conformance.protocol.layers import LAYERS_OF, check_layers
from conformance.protocol.port import AnyArray, Arrays, Case, Outputs, Unsupported
from conformance.protocol.stages import STAGES, check_input_shapes, check_inputs, check_output_shapes, find, require_inputs
from conformance.protocol.weights_file import serialise
from conformance.protocol.weights_format import take_format
from stss_ground.arguments import listing
from stss_ground.terminal import printable
from stss_ref.arrays import ArrayError
from stss_ref.weights import Weights, WeightsError, check

CASE = "0000"
"""Folder of a job's first case."""
LAYERS = "layers"
"""Folder of a case for the outputs of layers inside its stage; the judge makes it to ask for them."""
WEIGHTS = "weights.safetensors"
DTYPE = "float32"
"""The dtype of every float in a job, whatever the port's arithmetic."""
MOST_CASES = 100_000
"""Most cases of a job."""
MOST_BYTES = 2 * 2**30
"""Most bytes of a case's inputs; stage frame for an image of 7680 x 4320 has 1.9 GiB."""
MOST_HEADER = 10_000
"""Bytes of the header of a ``.npy`` file, as NumPy's ``max_header_size``."""
SPACES = 0, 0, 64, 256
"""Spaces at the end of an input's header, by its array's size: NumPy writes 128 bytes for nearly every array, other programs write more."""
MOST_HEADERS = 4096
"""Most headers that are kept: many cases have the same shapes."""
MOST_NAMES = 100
"""Most files of a folder that are looked at for a message."""
MOST_WEIGHTS_BYTES = 64 * 2**20
"""Most bytes of a weights file; this network's has 1.7 MiB."""


class JobError(ValueError):
    """A job folder breaks the protocol; the message names the file, what was expected and what was found, in one line."""

    def __init__(self, message: str):
        super().__init__(printable(message))


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
    files: dict[int, Path] = {}
    for number, case in enumerate(cases, first):
        folder = job / f"{number:04d}"
        check_inputs(case.stage, case.inputs, DTYPE)
        write_inputs(folder, case)
        if layers:
            (folder / LAYERS).mkdir()
        if not find(case.stage).weights:
            continue
        if case.weights is None:
            raise ArrayError(f"weights: missing; stage {case.stage} takes them")
        path = folder / "in" / WEIGHTS
        if id(case.weights) in files:
            link(files[id(case.weights)], path)
        else:
            path.write_bytes(serialise(case.weights))
            files[id(case.weights)] = path


def write_inputs(folder: Path, case: Case) -> None:
    """Write a case's stage and arrays into its folder. Names are those of any network, too: see `file_of`."""
    inside = folder / "in"
    inside.mkdir(parents=True)
    (folder / "stage").write_bytes(f"{case.stage}\n".encode("ascii"))
    for name, array in case.inputs.items():
        write_array(inside / file_of(name), array, spaces=SPACES[array.size % len(SPACES)])


@cache
def file_of(name: str) -> str:
    """The file of an array: all but letters, digits and ``_.-~`` of its name is written as ``%`` and two hexadecimal digits."""
    return f"{quote(name, safe='')}.npy"


def link(source: Path, path: Path) -> None:
    """Give the same 1.7 MB a second name; copy them where the file system has no links."""
    try:
        os.link(source, path)
    except OSError:
        shutil.copyfile(source, path)


def require_real(job: Path) -> None:
    """Raise JobError unless a job is a folder whose cases have real files and folders only: no links, no pipes, no devices."""
    if not job.is_dir():
        raise JobError(f"{job}: {'not a folder' if job.exists() else 'no such folder'}")
    try:
        with os.scandir(job) as entries:
            for entry in entries:
                _require_real(entry)
    except OSError as error:
        raise JobError(f"{error.filename}: {error.strerror}") from error


def _require_real(entry: os.DirEntry[str]) -> None:
    if entry.is_symlink():
        raise JobError(f"{entry.path}: a link; a job is a tree of real files")
    if entry.is_dir():
        with os.scandir(entry) as entries:
            for inner in entries:
                _require_real(inner)
    elif not entry.is_file():
        raise JobError(f"{entry.path}: not a file")


Stamps = dict[str, tuple[int, int, int]]


def stamps_of_inputs(job: Path, count: int) -> Stamps:
    """Inode, size and time of each input file of a job's first ``count`` cases, which show that it was written to."""
    stamps: Stamps = {}
    for number in range(count):
        try:
            with os.scandir(job / f"{number:04d}" / "in") as entries:
                stats = [(entry.path, entry.stat(follow_symlinks=False)) for entry in entries]
        except OSError:
            continue
        stamps |= {path: (stat.st_ino, stat.st_size, stat.st_mtime_ns) for path, stat in stats}
    return stamps


def require_unchanged(before: Stamps, after: Stamps) -> None:
    """Raise JobError if an input file has changed."""
    for path, stamp in before.items():
        if after.get(path) != stamp:
            raise JobError(f"{path}: {'changed' if path in after else 'removed'}; a program leaves its inputs as they are")


def case_folders(job: Path) -> list[Path]:
    """The folders of a job's cases, in order; other files beside them are ignored.

    Raises:
        JobError: the job is not a tree of real files, there is no case, or there are more than ``MOST_CASES``.
    """
    require_real(job)
    folders = [path for path in job.iterdir() if re.fullmatch(r"[0-9]{4,9}", path.name) and path.is_dir()]
    if not folders:
        raise JobError(f"{job}: no case in it; the first is a folder named 0000")
    if len(folders) > MOST_CASES:
        raise JobError(f"{job}: expected up to {MOST_CASES} cases, got {len(folders)}")
    return sorted(folders, key=lambda path: int(path.name))


def read_stage(case: Path) -> str:
    """The case's stage, which may be missing in the table: a later version of the project may have more stages."""
    text = read_bytes(case / "stage", 1 << 16)
    if not re.fullmatch(rb"[a-z0-9_]{1,64}\s*", text):
        raise JobError(f"{case / 'stage'}: expected one line, the name of a stage, got {text[:40]!r}")
    return text.decode().strip()


def read_bytes(path: Path, most: int) -> bytes:
    """All bytes of a file; JobError if it cannot be read or has more than ``most`` bytes."""
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as error:
        raise JobError(f"{path}: {'missing' if isinstance(error, FileNotFoundError) else error.strerror}") from error
    if len(data) > most:
        raise JobError(f"{path}: larger than {most} bytes")
    return data


def read_inputs(case: Path, stage: str) -> Outputs:
    """Read the arrays of ``case/in``, checked against the table.

    Raises:
        JobError: an array is missing, damaged, of another stage, or not as the table says; or together they exceed ``MOST_BYTES``.
    """
    folder = case / "in"

    def label(name: str) -> str:
        return f"{folder / name}.npy"

    def fits(arrays: Arrays) -> None:
        check_input_shapes(stage, arrays, DTYPE, label)
        if sum(array.nbytes for array in arrays.values()) > MOST_BYTES:
            largest = max(arrays, key=lambda name: arrays[name].nbytes)
            raise ArrayError(f"{label(largest)}: expected inputs of up to {MOST_BYTES >> 30} GiB in a case")

    try:
        require_inputs(stage, _names(folder), label)
        return _read_arrays(folder, find(stage).inputs, fits)
    except ArrayError as error:
        raise JobError(str(error)) from error


def _names(folder: Path) -> list[str]:
    """Names of the arrays in a folder; hidden files are those of file managers."""
    if not folder.is_dir():
        raise JobError(f"{folder}: {'not a folder' if folder.exists() else 'no such folder'}")
    return sorted(path.stem for path in folder.iterdir() if path.suffix == ".npy" and not path.name.startswith("."))


def read_weights(data: bytes, path: Path) -> Weights:
    """Read the tensors of a job's weights file.

    Args:
        data: all of its bytes.
        path: for messages.

    Raises:
        JobError: it is damaged, of another version, or a tensor does not fit the network.
    """
    try:
        tensors = dict(safetensors.deserialize(data))
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        choices = take_format(dict(header.get("__metadata__", {})))
        for name, tensor in tensors.items():
            if tensor["dtype"] != "F32":
                raise JobError(f"{path}: {name[:80]}: expected dtype F32, got {tensor['dtype']}")
        arrays = {
            name: np.frombuffer(tensor["data"], "<f4").astype(np.float32).reshape(tensor["shape"])
            for name, tensor in tensors.items()
        }
        return check(replace(choices, tensors=arrays))
    except WeightsError as error:
        raise JobError(f"{path}: {error}") from error
    except (safetensors.SafetensorError, ValueError) as error:
        if isinstance(error, JobError):
            raise
        raise JobError(f"{path}: damaged safetensors file ({error})") from error


def clear(case: Path) -> None:
    """Remove the outputs of an earlier run, so that results of two runs are never mixed.

    Raises:
        JobError: something there cannot be removed.
    """
    try:
        (case / "unsupported").unlink(missing_ok=True)
        for path in [*(case / "out").glob("*.npy"), *(case / LAYERS).glob("*.npy")]:
            path.unlink()
    except OSError as error:
        raise JobError(f"{error.filename}: {error.strerror}") from error


def write_outputs(case: Path, outputs: Arrays, into: str = "out") -> None:
    """Write ``case/out``, or layers into ``case/layers``."""
    try:
        (case / into).mkdir(exist_ok=True)
        for name, array in outputs.items():
            write_array(case / into / f"{name}.npy", array)
    except OSError as error:
        raise JobError(f"{error.filename}: {error.strerror}") from error


def write_array(path: Path, array: AnyArray, *, spaces: int = 0) -> None:
    """Write an array into a new file in version 1.0, little-endian, C order; integers as int32.

    Args:
        path: the file.
        array: the array.
        spaces: further ones at the header's end.

    Raises:
        ArrayError: an integer has more than 32 bits.
    """
    narrow = array.astype(np.int32) if array.dtype.kind in "iu" and array.dtype != np.uint8 else array
    if narrow is not array and (narrow != array).any():
        raise ArrayError(f"{path.stem}: expected integers of 32 bits")
    plain = narrow.astype(narrow.dtype.newbyteorder("<"), order="C", copy=False)
    with path.open("xb", buffering=0) as file:
        file.write(_header(plain.dtype, plain.shape, spaces))
        numbers = plain.reshape(-1).view(np.uint8).data
        while numbers:  # a system writes at most 2 GiB at once
            numbers = numbers[file.write(numbers) :]


@lru_cache(MOST_HEADERS)
def _header(dtype: np.dtype[Any], shape: tuple[int, ...], spaces: int) -> bytes:
    """The bytes before the numbers."""
    head = BytesIO()
    claim = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(head, claim)
    text = head.getvalue()[10:-1] + b" " * spaces + b"\n"
    return np.lib.format.magic(1, 0) + len(text).to_bytes(2, "little") + text


def write_unsupported(case: Path) -> None:
    """Write the file that says that the port lacks the stage."""
    try:
        (case / "unsupported").touch()
    except OSError as error:
        raise JobError(f"{error.filename}: {error.strerror}") from error


def read_outputs(case: Path, stage: str, sizes: Sizes) -> Outputs | Unsupported:
    """Read the outputs that a program left in ``case``; files that the table does not name are ignored.

    Args:
        case: the case's folder, a tree of real files.
        stage: the stage's name.
        sizes: the result of `check_inputs` for its inputs.

    Raises:
        JobError: an output is missing, damaged, or not as the table says.
    """
    specs, out = find(stage).outputs, case / "out"
    if (mark := case / "unsupported").exists():
        if there := [name for name in specs if (out / f"{name}.npy").exists()]:
            raise JobError(f"{out / there[0]}.npy: written, although {mark} says that there is no such stage")
        return Unsupported(stage)

    def label(name: str) -> str:
        return f"{out / name}.npy"

    try:
        return _read_arrays(out, specs, lambda arrays: check_output_shapes(stage, arrays, sizes, DTYPE, label))
    except ArrayError as error:
        raise JobError(str(error)) from error


def read_layers(case: Path, stage: str, inputs: Arrays) -> Outputs:
    """Read the layers that a program left: all, some or none.

    Raises:
        JobError: a file is neither a layer nor an output of the stage, is damaged, or misshapen.
    """
    folder = case / LAYERS
    if not folder.exists():
        return {}

    def label(name: str) -> str:
        return f"{folder / name}.npy"

    try:
        specs, names = LAYERS_OF.get(stage, {}), _names(folder)
        if unknown := [name for name in names if name not in specs and name not in STAGES[stage].outputs]:
            raise ArrayError(f"{label(unknown[0])}: not a layer of stage {stage}")
        some = {name: specs[name] for name in specs if name in names}
        return _read_arrays(folder, some, lambda arrays: check_layers(stage, arrays, inputs, label))
    except ArrayError as error:
        raise JobError(str(error)) from error


def read_array(path: Path) -> AnyArray:
    """Read one array of numbers; the result is C-contiguous in the machine's byte order.

    Raises:
        JobError: it is missing or damaged, holds anything but numbers, or exceeds ``MOST_BYTES``.
    """
    stored = _look(path)
    if stored.claim.nbytes > MOST_BYTES:
        raise JobError(f"{path}: expected up to {MOST_BYTES >> 30} GiB")
    return stored.load()


def _others(folder: Path) -> str:
    """The names in a folder, for the message on a missing file: a porter may have spelled its name in another way."""
    if not folder.is_dir():
        return f"there is no folder {folder.name}"
    names = sorted(each.name for each in islice(folder.iterdir(), MOST_NAMES))
    return f"{folder.name} holds {listing(names, 8) or 'nothing'}"


@dataclass(frozen=True)
class _Stored:
    """An array in a file of which only the header was read; ``claim`` has its shape and dtype, and no memory."""

    path: Path
    claim: AnyArray
    offset: int
    order: Literal["C", "F"]

    def load(self) -> AnyArray:
        """Its numbers, C-contiguous in the machine's byte order; JobError if they cannot be read."""
        try:
            numbers = np.fromfile(self.path, self.claim.dtype, self.claim.size, offset=self.offset)
            shaped = numbers.reshape(self.claim.shape, order=self.order)
        except (OSError, ValueError) as error:  # it was cut off meanwhile
            raise JobError(f"{self.path}: {_first_line(error)}") from error
        return np.asarray(shaped, shaped.dtype.newbyteorder("="), order="C")


def _look(path: Path) -> _Stored:
    """A file's array, whose numbers are not yet read."""
    if not path.is_file():
        raise JobError(f"{path}: {'not a file' if path.exists() else f'missing; {_others(path.parent)}'}")
    try:
        with path.open("rb") as file:
            shape, is_fortran, dtype = _read_header(file)
            if dtype.hasobject:
                raise ValueError("Python objects")
            claim, offset, there = np.broadcast_to(np.empty((), dtype), shape), file.tell(), os.fstat(file.fileno()).st_size
        if there < offset + claim.nbytes:
            raise ValueError(f"it has {there} bytes, expected {offset + claim.nbytes}")
    except Exception as error:
        # A stranger's text, which NumPy evaluates as a literal: it raises more than ValueError.
        raise JobError(f"{path}: not a .npy file of numbers: {_first_line(error)}") from error
    if dtype.kind not in "biuf" or dtype.subdtype is not None:
        raise JobError(f"{path}: expected an array of numbers, got {_first_line(dtype)}")
    return _Stored(path, claim, offset, "F" if is_fortran else "C")


def _read_header(file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether the order is Fortran's, and dtype; ValueError for a header that NumPy would not take.

    NumPy reads one of 4 GiB before it looks, so its length is looked at first.
    """
    start = file.read(12)
    length = int.from_bytes(start[8:10] if start[6:7] == b"\x01" else start[8:12], "little")
    if length > MOST_HEADER:
        raise ValueError(f"its header claims {length} bytes, expected up to {MOST_HEADER}")
    file.seek(0)
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(file)
    if version == (2, 0):
        return np.lib.format.read_array_header_2_0(file)
    raise ValueError(f"expected version 1.0 or 2.0, got {version[0]}.{version[1]}")


def _first_line(value: object) -> str:
    """The first line of its text, cut off."""
    lines = str(value).splitlines()
    return lines[0][:100] if lines else type(value).__name__


def _read_arrays(folder: Path, specs: Mapping[str, ArraySpec], fits: Callable[[Arrays], None]) -> Outputs:
    """The arrays of these names; ``fits`` is called before the first number is read, and raises ArrayError."""
    stored = {name: _look(folder / f"{name}.npy") for name in specs}
    fits({name: each.claim for name, each in stored.items()})
    arrays = {name: each.load() for name, each in stored.items()}
    check_numbers(specs, arrays, lambda name: f"{folder / name}.npy")
    return arrays
