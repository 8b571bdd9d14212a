# SPDX-License-Identifier: MIT
"""The network as an ONNX model, for other engines: `stss export`.

Its form is the one that ONNX Runtime and OpenVINO run fastest. Measured at 960 x 544 on two threads of a
Zen 4: computing a gate in its feature's convolution, instead of in a separate one, saves 4 to 8 %; the ERM's window as 25 slices and
as a depthwise "unfold" differ by at most 4 %, and either may be the faster one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stss.weights.file import identity
from stss_cl.graph import GRAPH, evaluate
from stss_ground.errors import InputError
from stss_ground.optional import require
from stss_ground.output.write_whole import write_named
from stss_ground.version import VERSION
from stss_ref.erm import LEAST_LENGTH, LEAST_SUM, WINDOW
from stss_ref.weights import Layer, Weights

OPSET = 17
IR_VERSION = 8
"""Version of the file format: the one of opset 17's time, so that older engines read it."""
INPUTS = {"color": (1, 6), "gbuffer": (1, 9), "mask": (1, 1), "history": (3, 4)}
"""First two axes of each input, (N, C); the other two are (H, W)."""


def export(weights: Weights, height: int, width: int) -> Any:
    """The network for frames of one size, as an ``onnx.ModelProto``.

    Source: spec 7, 8; paper, Fig. 5.

    Args:
        weights: the 92 tensors.
        height, width: H, W of the inputs, multiples of 8: pad below and right by replicating the last row or column.

    Returns:
        Model of opset 17, float32. Inputs, channels first: color (1, 6, H, W), gbuffer (1, 9, H, W), mask (1, 1, H, W), history
        (3, 4, H, W), oldest first. Output: image (1, 3, 2H, 2W), not clipped.

    Raises:
        InputError: the size is not of multiples of 8, or onnx is not installed.
    """
    if height < 8 or width < 8 or height % 8 or width % 8:
        raise InputError(f"size {width}x{height}: expected multiples of 8, such as {-(-width // 8) * 8}x{-(-height // 8) * 8}")
    return _Exporter(weights, height, width).model()


def write(path: Path, weights: Weights, height: int, width: int) -> None:
    """Write `export` of ``weights`` to ``path``, whole or not at all.

    Raises:
        InputError: see `export`; or the file cannot be written.
    """
    write_named(path, export(weights, height, width).SerializeToString())


class _Graph:
    """The nodes and constants of a graph while it is built; each value has a name."""

    def __init__(self) -> None:
        self.onnx = require("onnx")
        require("onnx.helper")
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}

    def op(self, kind: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        """Add a node with one output; returns the output's name."""
        return self.node(kind, inputs, [output or f"{kind.lower()}_{len(self.nodes)}"], **attributes)[0]

    def node(self, kind: str, inputs: Sequence[str], outputs: list[str], **attributes: Any) -> list[str]:
        """Add a node; returns the names of its outputs."""
        self.nodes.append(self.onnx.helper.make_node(kind, list(inputs), outputs, name=f"{kind}_{len(self.nodes)}", **attributes))
        return outputs

    def constant(self, name: str, value: NDArray[Any]) -> str:
        """Add a constant, unless there is one called ``name``; returns its name."""
        if name not in self.constants:
            self.constants[name] = self.onnx.numpy_helper.from_array(np.ascontiguousarray(value), name)
        return name

    def integers(self, *values: int) -> str:
        """Add a constant int64 (n,); returns its name."""
        return self.constant("i" + "_".join(map(str, values)), np.array(values, np.int64))

    def number(self, value: float) -> str:
        """Add a constant float32 (); returns its name."""
        return self.constant(f"f{value}", np.array(value, np.float32).reshape(()))


class _Exporter(_Graph):
    """The network from its graph; the methods are those of `stss_cl.graph.Operations`."""

    def __init__(self, weights: Weights, height: int, width: int):
        super().__init__()
        self.weights, self.height, self.width = weights, height, width

    def model(self) -> Any:
        """Build the whole model, and check it."""
        self.network()
        helper, float32 = self.onnx.helper, self.onnx.TensorProto.FLOAT
        size = self.height, self.width
        inputs = [helper.make_tensor_value_info(name, float32, (*lead, *size)) for name, lead in INPUTS.items()]
        image = helper.make_tensor_value_info("image", float32, (1, 3, 2 * size[0], 2 * size[1]))
        graph = helper.make_graph(self.nodes, "stss", inputs, [image], list(self.constants.values()))
        opset = helper.make_opsetid("", OPSET)
        model = helper.make_model(
            graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="stss", producer_version=VERSION
        )
        helper.set_model_props(model, {"weights": identity(self.weights)})
        self.onnx.checker.check_model(model, full_check=True)
        return model

    def network(self) -> None:
        """Stage ``network``."""
        results = evaluate(self, "color", "gbuffer", "mask", "history")
        residual = self.op("DepthToSpace", results[GRAPH[-1].name], blocksize=2, mode="CRD")
        newest = self.op("Slice", "color", self.integers(0), self.integers(3), self.integers(1))
        self.op("Add", residual, self.resize(newest, 2, "half_pixel"), output="image")

    def convolve(self, x: str, layer: Layer) -> str:
        """A layer with its gate, which is its convolution's last channel, and its ReLU."""
        kinds = ("weight", "bias")
        names = [name for name, _ in layer.tensors()]
        weight, bias = (
            self.constant(f"{layer.name}.{kind}", np.concatenate([self.weights[name] for name in names[i::2]]))
            for i, kind in enumerate(kinds)
        )
        side, stride = layer.kernel, layer.stride
        y = self.op("Conv", x, weight, bias, kernel_shape=[side] * 2, strides=[stride] * 2, pads=[side // 2] * 4)
        if layer.gated:
            parts = [f"{layer.name}.feature", f"{layer.name}.gate"]
            feature, gate = self.node("Split", (y, self.integers(layer.outputs, 1)), parts, axis=1)
            y = self.multiply(feature, self.op("Sigmoid", gate))
        return self.op("Relu", y) if layer.relu else y

    def attend(self, light: str, material: str, mask: str) -> str:
        """``sum_d relu(key(p + d) . query(p)) value(p + d) / max(sum_d relu(key(p + d) . query(p)), 1e-6)``."""
        r = WINDOW // 2
        length = self.op("Max", self.op("ReduceL2", material, axes=[1], keepdims=1), self.number(LEAST_LENGTH))
        query = self.op("Div", material, length)
        pads = self.integers(0, 0, r, r, 0, 0, r, r)
        key, value = (self.op("Pad", self.multiply(x, mask), pads) for x in (query, light))
        axes = self.integers(2, 3)
        total = weight_sum = ""
        for v in range(WINDOW):
            for u in range(WINDOW):
                there = self.integers(v, u), self.integers(v + self.height // 8, u + self.width // 8), axes
                product = self.multiply(self.op("Slice", key, *there), query)
                weight = self.op("Relu", self.op("ReduceSum", product, self.integers(1), keepdims=1))
                term = self.multiply(self.op("Slice", value, *there), weight)
                total = self.op("Add", total, term) if total else term
                weight_sum = self.op("Add", weight_sum, weight) if weight_sum else weight
        return self.op("Div", total, self.op("Max", weight_sum, self.number(LEAST_SUM)))

    def upsample(self, x: str) -> str:
        """Twice the size, corners aligned."""
        return self.resize(x, 2, "align_corners")

    def reduce(self, x: str) -> str:
        """An eighth of the size."""
        return self.resize(x, 0.125, "half_pixel")

    def multiply(self, x: str, y: str) -> str:
        """The product."""
        return self.op("Mul", x, y)

    def join(self, values: Sequence[str]) -> str:
        """Concatenate along the channels."""
        return self.op("Concat", *values, axis=1) if len(values) > 1 else values[0]

    def join_images(self, x: str) -> str:
        """The three frames of the history, which are one batch since they share their weights, side by side."""
        return self.op("Reshape", x, self.integers(1, -1, self.height // 8, self.width // 8))

    def resize(self, x: str, scale: float, grid: str) -> str:
        """Resize bilinearly, without a prefilter; ``grid`` is ONNX's name for the places of samples."""
        scales = self.constant(f"scale{scale}", np.array([1, 1, scale, scale], np.float32))
        return self.op("Resize", x, "", scales, mode="linear", coordinate_transformation_mode=grid)
