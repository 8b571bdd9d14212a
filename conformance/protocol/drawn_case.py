# SPDX-License-Identifier: MIT
"""A property's own case on disk: numbers, words, lists and arrays nested in each other, as Hypothesis drew them.

``property.json`` has the test's id and the structure; arrays lie beside it as ``0000.npy``, ... Nothing that is read is executed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from conformance.protocol.job_folder import JobError, read_array, read_bytes
from conformance.protocol.port import AnyArray
from stss_ref.constants import HOLE_FILLS, HOLE_TESTS
from stss_ref.weights import SECOND_COLORS, Weights

CASES_FOLDER = "property"
"""Folder of a failure for its cases."""
PROPERTY = "property.json"
MOST_BYTES = 1 << 24
"""Largest size of the structure; hundreds of frames with their own weights, which fail together and were not made fewer, have 1.2 MB."""


def fingerprint(case: Any) -> bytes:
    """A digest that is equal for equal cases: of floats in float32, as ports get them, since float64's last bits depend on the machine."""
    digest = hashlib.blake2b()

    def note(array: AnyArray) -> str:
        with np.errstate(over="ignore"):
            numbers = array.astype("<f4", copy=False) if array.dtype.kind == "f" else array
        digest.update(np.ascontiguousarray(numbers).data)
        return f"{numbers.shape}{numbers.dtype}"

    digest.update(json.dumps(_to_json(case, note)).encode())
    return digest.digest()


def write_drawn(folder: Path, test: str, case: Any) -> None:
    """Write the case of a test into ``folder``.

    Raises:
        TypeError: it holds anything but numbers, words, lists, tuples, dictionaries of words and arrays.
    """
    arrays: dict[int, tuple[str, AnyArray]] = {}

    def note(array: AnyArray) -> str:
        name, _ = arrays.setdefault(id(array), (f"{len(arrays):04d}.npy", array))
        return name

    text = json.dumps({"test": test, "drawn": _to_json(case, note)})
    (folder / PROPERTY).write_text(text, encoding="utf-8")
    for name, array in arrays.values():
        np.save(folder / name, np.ascontiguousarray(array), allow_pickle=False)


def _to_json(value: Any, note: Callable[[AnyArray], str]) -> Any:
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, (float, np.floating, np.integer, np.bool_)):
        return {"float": repr(float(value))} if isinstance(value, (float, np.floating)) else value.item()
    if isinstance(value, np.ndarray):
        return {"array": note(value)}
    if isinstance(value, (list, tuple)):
        return {type(value).__name__: [_to_json(item, note) for item in value]}
    if isinstance(value, Weights):
        return {"weights": [value.second_color, value.hole_test, value.hole_fill, _to_json(dict(value), note)]}
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {"dict": {key: _to_json(item, note) for key, item in value.items()}}
    raise TypeError(f"expected numbers, words, lists and arrays, got {type(value).__name__}")


def read_drawn(folder: Path) -> tuple[str, Any]:
    """Read the test's id and its case.

    Raises:
        JobError: it is damaged.
    """
    path = folder / PROPERTY
    try:
        data = json.loads(read_bytes(path, MOST_BYTES))
        return str(data["test"]), _read(data["drawn"], folder, {})
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        if isinstance(error, JobError):
            raise
        raise JobError(f"{path}: damaged ({type(error).__name__})") from error


def _read(value: Any, folder: Path, arrays: dict[str, AnyArray]) -> Any:
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "array":
        name = str(content)
        if "/" in name or "\\" in name:
            raise ValueError(name)
        if name not in arrays:
            arrays[name] = read_array(folder / name)
        return arrays[name]
    if kind == "float":
        return float(content)
    if kind == "dict":
        return {str(key): _read(item, folder, arrays) for key, item in content.items()}
    if kind == "weights":
        second, test, fill, tensors = content
        choices = (
            SECOND_COLORS[SECOND_COLORS.index(second)],
            HOLE_TESTS[HOLE_TESTS.index(test)],
            HOLE_FILLS[HOLE_FILLS.index(fill)],
        )
        return Weights(_read(tensors, folder, arrays), *choices)
    items = [_read(item, folder, arrays) for item in content]
    return {"list": list, "tuple": tuple}[kind](items)
