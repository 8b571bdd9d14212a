# SPDX-License-Identifier: MIT
"""Sizes and kinds of arrays in the form of the stage table, and the check of arrays against them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from conformance.protocol.port import AnyArray, Arrays
from stss_ref.arrays import ArrayError

Kind = Literal["float", "uint8", "int"]
"""``float``: float32, or float64 for the truth; ``uint8``: a mask of 0 and 1; ``int``: any integers, int32 in files."""
Sizes = dict[str, int]
"""Size of each letter."""
Label = Callable[[str], str]
"""Turns an array's name into the name that an error shows, such as its file."""


@dataclass(frozen=True)
class Dim:
    """Size along one axis: ``times * letter / over``, or ``times`` where there is no letter."""

    times: int
    letter: str
    over: int

    def length(self, sizes: Sizes) -> int:
        """In pixels or whatever the axis counts."""
        return self.times * sizes[self.letter] // self.over if self.letter else self.times

    def __str__(self) -> str:
        if not self.letter:
            return str(self.times)
        return f"{self.times if self.times > 1 else ''}{self.letter}{f'/{self.over}' if self.over > 1 else ''}"


@dataclass(frozen=True)
class ArraySpec:
    """Sizes and kind of one array."""

    dims: tuple[Dim, ...]
    kind: Kind

    def shape(self, sizes: Sizes) -> tuple[int, ...]:
        """The shape for these sizes."""
        return tuple(dim.length(sizes) for dim in self.dims)

    def __str__(self) -> str:
        return "(" + ", ".join(map(str, self.dims)) + ("," if len(self.dims) == 1 else "") + ")"

    def check(self, name: str, array: AnyArray, sizes: Sizes) -> None:
        """Raise ArrayError unless shape and kind fit; letters it is the first to have go into ``sizes``."""
        bound = dict(sizes)
        if array.ndim == len(self.dims):
            for dim, length in zip(self.dims, array.shape, strict=True):
                if dim.letter:
                    bound.setdefault(dim.letter, length * dim.over // dim.times)
        if array.ndim != len(self.dims) or array.shape != self.shape(bound) or 0 in array.shape:
            lengths = [str(dim.length(sizes)) if not dim.letter or dim.letter in sizes else str(dim) for dim in self.dims]
            shape = ", ".join(lengths) + ("," if len(lengths) == 1 else "")
            raise ArrayError(f"{name}: expected shape ({shape}), got {array.shape}")
        if self.kind == "int" and array.dtype.kind not in "iu":
            raise ArrayError(f"{name}: expected integers, got {array.dtype}")
        if self.kind == "uint8" and array.dtype != np.uint8:
            raise ArrayError(f"{name}: expected dtype uint8, got {array.dtype}")
        sizes.update(bound)

    def check_numbers(self, name: str, array: AnyArray) -> None:
        """Raise ArrayError where a mask holds more than 0 and 1."""
        if self.kind == "uint8" and array.max() > 1:
            first = tuple(int(i) for i in np.argwhere(array > 1)[0])
            raise ArrayError(f"{name}: expected 0 and 1, got {array[first]}, first at index {first}")


def array_spec(text: str) -> ArraySpec:
    """Parse ``"H/8 W/8 32"``, ``"H W uint8"`` or ``"4 int"``."""
    *words, last = text.split()
    if last not in ("uint8", "int"):
        return ArraySpec(tuple(map(_dim, [*words, last])), "float")
    return ArraySpec(tuple(map(_dim, words)), "uint8" if last == "uint8" else "int")


def _dim(word: str) -> Dim:
    match = re.fullmatch(r"(\d*)([A-Za-z]?)(?:/(\d+))?", word)
    assert match is not None, word
    return Dim(int(match[1] or 1), match[2], int(match[3] or 1))


def check_shapes(specs: Mapping[str, ArraySpec], arrays: Arrays, sizes: Sizes, dtype: str | None, label: Label) -> Sizes:
    """Check shape and dtype of every array of ``specs``; other arrays and all numbers are ignored.

    Args:
        specs: the arrays expected; sizes become known in this order.
        arrays: the arrays found.
        sizes: the sizes of letters that are already known.
        dtype: the dtype of all floats; None: the dtype of the first one, float32 or float64.
        label: turns an array's name into the name that an error shows.

    Returns:
        The sizes of all letters.

    Raises:
        ArrayError: an array is missing or does not fit.
    """
    sizes = dict(sizes)
    for name, spec in specs.items():
        if name not in arrays:
            raise ArrayError(f"{label(name)}: missing")
        array = arrays[name]
        spec.check(label(name), array, sizes)
        if spec.kind == "float":
            native = array.dtype.newbyteorder("=")
            if native not in ([dtype] if dtype else ["float32", "float64"]):
                raise ArrayError(f"{label(name)}: expected dtype {dtype or 'float32 or float64'}, got {array.dtype}")
            dtype = native.name
    return sizes


def check_numbers(specs: Mapping[str, ArraySpec], arrays: Arrays, label: Label) -> None:
    """Raise ArrayError where a mask holds more than 0 and 1."""
    for name, spec in specs.items():
        spec.check_numbers(label(name), arrays[name])


def require_multiples(inputs: Mapping[str, ArraySpec], outputs: Mapping[str, ArraySpec], sizes: Sizes, label: Label) -> None:
    """Raise ArrayError if an output such as ``H/8`` needs a multiple of 8 and H is not one."""
    dims = [dim for spec in (*inputs.values(), *outputs.values()) for dim in spec.dims]
    for dim in dims:
        if dim.letter and sizes[dim.letter] % dim.over:
            worst = max(other.over for other in dims if other.letter == dim.letter)
            name = next(name for name, spec in inputs.items() if dim.letter in [d.letter for d in spec.dims])
            raise ArrayError(f"{label(name)}: expected {dim.letter} to be a multiple of {worst}, got {sizes[dim.letter]}")
