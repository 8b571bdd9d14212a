# SPDX-License-Identifier: MIT
"""An ONNX model as nodes and constants, read without running anything of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from conformance.graph.operators import OPERATORS, Node
from conformance.graph.rounding import AnyArray
from stss_ground.errors import InputError
from stss_ground.optional import require
from stss_ground.regular_file import require_regular

MOST_BYTES = 2 * 2**30
"""Most bytes of a model and of its external data, by its format."""
OPSETS = range(13, 23)
DTYPES = {1: "float32", 10: "float16", 11: "float64", 6: "int32", 7: "int64", 2: "uint8", 9: "bool"}
"""ONNX's number of a type -> its name."""


@dataclass(frozen=True)
class Input:
    """An input: its name, its type, and its shape; a string stands for a size that any call may choose."""

    name: str
    dtype: str
    shape: tuple[int | str, ...]


@dataclass(frozen=True)
class Model:
    """A network.

    Attributes:
        path: of the file.
        inputs: those that a call brings.
        outputs: names.
        nodes: those that can be judged, in order.
        constants: by name.
        unknown: a line for each node that cannot be judged, without the nodes that depend on it.
        dtype: its arithmetic: float16 where it stores half, else float32.
    """

    path: Path
    inputs: tuple[Input, ...]
    outputs: tuple[str, ...]
    nodes: tuple[Node, ...]
    constants: Mapping[str, AnyArray]
    unknown: tuple[str, ...]
    dtype: str = "float32"

    @property
    def tensors(self) -> list[str]:
        """Names of all results, in order."""
        return [name for node in self.nodes for name in node.outputs if name]


def load_model(path: Path) -> Model:
    """Read a model.

    Raises:
        InputError: it cannot be read, is not ONNX or of another opset, its external data are missing, or no node of it is known.
    """
    onnx = require("onnx", "onnx")
    require("onnx.numpy_helper", "onnx")
    proto = _read(onnx, path)
    opset = next((entry.version for entry in proto.opset_import if entry.domain in ("", "ai.onnx")), 0)
    if opset not in OPSETS:
        raise InputError(
            f"{path}: expected opset {OPSETS[0]} to {OPSETS[-1]}, found {opset}; onnx.version_converter may convert it"
        )
    graph = proto.graph
    constants = {each.name: _constant(onnx, path, each) for each in graph.initializer}
    inputs = tuple(_input(path, each) for each in graph.input if each.name not in constants)
    names = {"", *constants, *(each.name for each in inputs)}
    nodes: list[Node] = []
    unknown: list[str] = []
    for number, each in enumerate(graph.node):
        label = f"{each.name or f'node {number}'} ({each.op_type})"
        missing = next((name for name in each.input if name not in names), None)
        if each.domain not in ("", "ai.onnx") or each.op_type not in OPERATORS:
            unknown.append(f"{label}: operator {each.domain + '.' if each.domain else ''}{each.op_type}")
        elif missing is None:
            attributes = {a.name: _attribute(onnx, a) for a in each.attribute}
            nodes.append(Node(each.op_type, attributes, tuple(each.input), tuple(each.output)))
            names |= {*each.output}
    if not nodes:
        raise InputError(f"{path}: no node can be judged{': ' + unknown[0] if unknown else ''}")
    is_half = any(DTYPES.get(each.data_type) == "float16" for each in graph.initializer) or any(
        each.dtype == "float16" for each in inputs
    )
    outputs = tuple(each.name for each in graph.output)
    return Model(path, inputs, outputs, tuple(nodes), constants, tuple(unknown), "float16" if is_half else "float32")


def _read(onnx: Any, path: Path) -> Any:
    try:
        size = require_regular(path)
        if size > MOST_BYTES:
            raise InputError(f"{path}: expected up to {MOST_BYTES >> 30} GiB, found {size / 2**30:.1f}")
        proto = onnx.load(path, load_external_data=False)
        for each in proto.graph.initializer:
            for entry in each.external_data:
                if entry.key == "location":
                    require_regular(_beside(path, entry.value))
        unsaid = [each.type.tensor_type for each in proto.graph.output if not each.type.tensor_type.HasField("shape")]
        for each in unsaid:  # engines run such a model; the checker asks for a shape, which nothing here needs
            each.shape.SetInParent()
        onnx.checker.check_model(proto if unsaid else str(path))
        return onnx.load(path)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{error.filename or path}: {error.strerror or error}") from error
    except Exception as error:
        # A stranger's file: its parser and checker raise errors of several libraries.
        lines = str(error).strip().splitlines()
        raise InputError(f"{path}: not an ONNX model: {lines[0][:160] if lines else type(error).__name__}") from error


def _beside(path: Path, location: str) -> Path:
    """External data lie beside the model or below."""
    place = (path.parent / location).resolve()
    if not place.is_relative_to(path.parent.resolve()):
        raise InputError(f"{path}: external data outside of its folder: {location[:80]!r}")
    return place


def _constant(onnx: Any, path: Path, tensor: Any) -> AnyArray:
    array = onnx.numpy_helper.to_array(tensor)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        bad = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f"{path}: {tensor.name}: not finite, first at index {bad}")
    return array.astype(np.float64) if array.dtype.kind not in "biu" else array


def _input(path: Path, each: Any) -> Input:
    kind = each.type.tensor_type
    if kind.elem_type not in DTYPES:
        raise InputError(f"{path}: input {each.name}: expected a tensor of {', '.join(DTYPES.values())}")
    shape = tuple(
        d.dim_value if d.dim_value > 0 else d.dim_param if d.dim_param.isidentifier() else f"{each.name}.{i}"
        for i, d in enumerate(kind.shape.dim)
    )
    return Input(each.name, DTYPES[kind.elem_type], shape)


def _attribute(onnx: Any, attribute: Any) -> Any:
    value = onnx.helper.get_attribute_value(attribute)
    if isinstance(value, bytes):
        return value.decode()
    if attribute.type == onnx.AttributeProto.TENSOR:
        return onnx.numpy_helper.to_array(value)
    return [*value] if attribute.type in (onnx.AttributeProto.INTS, onnx.AttributeProto.FLOATS) else value
