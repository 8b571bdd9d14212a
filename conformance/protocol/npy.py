# SPDX-License-Identifier: MIT
"""Read the .npy files of a job: the header first, and the numbers only after the header was checked.

Nothing that is read is executed, and no memory is allocated for numbers that a file only claims to have.
"""

from __future__ import annotations

import io
import os
import warnings
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from conformance.protocol.job_tree import JobError
from conformance.protocol.port import AnyArray
from stss_ref.arrays import ArrayError

MOST_HEADER = 10_000
"""Bytes of a header's text; NumPy's own limit."""
_READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


@dataclass(frozen=True)
class Claim:
    """The description of the numbers in a file's header.

    Attributes:
        shape: each length at least 0.
        dtype: integers, floats or bool, in the machine's byte order.
        stored: the same in the file's byte order.
        fortran: whether the first axis is the fastest.
        start: byte of the file where the numbers begin.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    stored: np.dtype[Any]
    fortran: bool
    start: int

    @property
    def ndim(self) -> int:
        """How many axes."""
        return len(self.shape)

    @property
    def nbytes(self) -> int:
        """Of the numbers."""
        return prod(self.shape) * self.dtype.itemsize


def read_claim(path: Path, file: BinaryIO) -> Claim:
    """Read the header of an open file, and check its length and kind against the limits and its claim against the file's size.

    Raises:
        JobError: it is not a header, it describes objects, or the file does not have as many bytes as it claims.
    """
    text = _header(path, file)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            shape, fortran, dtype = _READERS[text[6], text[7]](io.BytesIO(text[8:]), max_header_size=MOST_HEADER)
    except Exception as error:
        # A stranger's text, which NumPy evaluates as a literal: more than ValueError comes out.
        raise JobError(f"{path}: not a .npy file: {short(error)}") from error
    if dtype.hasobject:
        raise JobError(f"{path}: an array of objects, which only executing it could read; expected numbers")
    if dtype.kind not in "biuf" or dtype.subdtype is not None:
        raise JobError(f"{path}: expected an array of numbers, got {short(dtype)}")
    if any(n < 0 for n in shape):
        raise JobError(f"{path}: a negative size in its shape {short(shape)}")
    claim = Claim(tuple(map(int, shape)), dtype.newbyteorder("="), dtype, fortran, len(text))
    expected, got = claim.start + claim.nbytes, os.fstat(file.fileno()).st_size
    if expected != got:
        raise JobError(f"{path}: expected {short(expected)} bytes for {dtype} of shape {short(shape)}, got {got}")
    return claim


def _header(path: Path, file: BinaryIO) -> bytes:
    """Check magic, version and length, and return the text; no more than the limit is read of a file that claims more."""
    start = file.read(12)
    if len(start) < 10 or not start.startswith(np.lib.format.MAGIC_PREFIX):
        raise JobError(f"{path}: not a .npy file: expected it to begin with {np.lib.format.MAGIC_PREFIX!r}")
    if (start[6], start[7]) not in _READERS:
        raise JobError(f"{path}: expected version 1.0 or 2.0 of the .npy format, got {start[6]}.{start[7]}")
    digits = 2 if start[6] == 1 else 4
    size = int.from_bytes(start[8 : 8 + digits], "little")
    if size > MOST_HEADER:
        raise JobError(f"{path}: not a .npy file: expected a header of up to {MOST_HEADER} bytes, got {size}")
    return (start + file.read(MOST_HEADER))[: 8 + digits + size]


def read_numbers(path: Path, file: BinaryIO, claim: Claim) -> AnyArray:
    """Read the numbers after a checked header; the result is C-contiguous in the machine's byte order."""
    file.seek(claim.start)
    count = prod(claim.shape)
    numbers = np.fromfile(file, claim.stored, count)
    if numbers.size != count:
        raise JobError(f"{path}: it became shorter while it was read")
    array = numbers.reshape(claim.shape[::-1]).T if claim.fortran else numbers.reshape(claim.shape)
    return array.astype(claim.dtype, order="C", copy=False)


def write_array(name: str, file: BinaryIO, array: AnyArray) -> None:
    """Write an array in version 1.0, little-endian, C order; integers as int32.

    Raises:
        ArrayError: an integer has more than 32 bits.
    """
    narrow = array.astype(np.int32) if array.dtype.kind in "iu" and array.dtype != np.uint8 else array
    if narrow is not array and (narrow != array).any():
        raise ArrayError(f"{name}: expected integers of 32 bits")
    plain = narrow.astype(narrow.dtype.newbyteorder("<"), order="C", copy=False)
    np.lib.format.write_array(file, plain, version=(1, 0), allow_pickle=False)


def short(value: object) -> str:
    """The first line of its text, cut off."""
    try:
        lines = str(value).splitlines()
    except ValueError:
        # An integer of thousands of digits.
        return "a number out of all bounds"
    return lines[0][:100] if lines else type(value).__name__
