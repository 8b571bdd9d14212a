"""The judge of any network: operators against ONNX's own, mistakes to find, right ports to pass."""

import importlib
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from conformance.answers.port_arithmetic import Arithmetic
from conformance.command import conform
from conformance.graph import report
from conformance.graph.judgement import compare, compute, round_to
from conformance.graph.model import load_model
from conformance.graph.operators import Node
from conformance.graph.ports import load_graph_port
from conformance.graph.rounding import Rounding
from conformance.graph.run import judge_port
from conformance.options import PortChoice
from conformance.protocol.drawn_case import read_drawn
from stss_ground.errors import InputError
from tests.tiers import every

onnx = pytest.importorskip("onnx", reason="onnx is not installed: pip install onnx")
helper, FLOAT = onnx.helper, onnx.TensorProto.FLOAT
reference = pytest.importorskip("onnx.reference")
F32 = Rounding(Arithmetic())


def model_of(nodes, inputs, outputs, constants=None, opset=18):
    inputs_info = [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in inputs.items()]
    outputs_info = [
        helper.make_tensor_value_info(name, FLOAT, [f"{name}{i}" for i in range(rank)]) for name, rank in outputs.items()
    ]
    tensors = [onnx.numpy_helper.from_array(array, name) for name, array in (constants or {}).items()]
    graph = helper.make_graph(nodes, "made", inputs_info, outputs_info, tensors)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)


def agrees(op, *arrays, **attributes):
    """One node by ONNX's reference in float32, and by ours within its bound."""
    names = [f"i{k}" if array is not None else "" for k, array in enumerate(arrays)]
    outputs = [f"o{k}" for k in range(attributes.pop("outputs", 1))]
    arrays_of = {name: array for name, array in zip(names, arrays, strict=True) if array is not None}
    node = helper.make_node(op, names, outputs, **attributes)
    want = reference.ReferenceEvaluator(model_of([node], {}, dict.fromkeys(outputs, 1), arrays_of)).run(None, {})
    wide = [None if a is None else a.astype(np.float64) if a.dtype.kind == "f" else a for a in arrays]
    arrays_of = {k: onnx.numpy_helper.to_array(v) if isinstance(v, onnx.TensorProto) else v for k, v in attributes.items()}
    ours = Node(op, arrays_of, tuple(names), tuple(outputs))
    for name, right, got in zip(outputs, compute(ours, wide, F32), want, strict=True):
        assert compare(name, ours, wide, np.asarray(got), right).ratio <= 1, (op, attributes)


def small_model(dtype):
    """A convolution with a bias, and what follows it."""
    random = np.random.default_rng(0)
    w, b = random.normal(size=(4, 3, 3, 3)).astype(dtype), random.normal(size=4).astype(dtype)
    nodes = [helper.make_node("Conv", ["x", "w", "b"], ["y"], pads=[1] * 4), helper.make_node("Relu", ["y"], ["z"])]
    kind = onnx.helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
    shapes = {"x": [1, 3, 8, 8], "z": [1, 4, 8, 8]}
    x, z = (helper.make_tensor_value_info(name, kind, shape) for name, shape in shapes.items())
    graph = helper.make_graph(
        nodes, "small", [x], [z], [onnx.numpy_helper.from_array(w, "w"), onnx.numpy_helper.from_array(b, "b")]
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)


def ints(*values):
    return np.array(values, np.int64)


@st.composite
def windows(draw):
    kernel, stride, dilation = (draw(st.tuples(st.integers(1, n), st.integers(1, n))) for n in (3, 3, 2))
    pads = [draw(st.integers(0, k - 1)) for k in (*kernel, *kernel)]
    return {"kernel_shape": kernel, "strides": stride, "dilations": dilation, "pads": pads}


@settings(max_examples=40, deadline=None)
@given(
    window=windows(),
    groups=st.sampled_from([1, 2]),
    seed=st.integers(0, 99),
    auto=st.sampled_from(["NOTSET", "SAME_UPPER", "SAME_LOWER", "VALID"]),
)
def test_convolutions_agree_with_onnx(window, groups, seed, auto):
    random = np.random.default_rng(seed)
    x, w = (random.standard_normal(s).astype(np.float32) for s in ((2, 4, 9, 8), (6, 4 // groups, *window["kernel_shape"])))
    b = random.standard_normal(6).astype(np.float32)
    if auto != "NOTSET":
        window = {k: v for k, v in window.items() if k != "pads"} | {"auto_pad": auto, "dilations": (1, 1)}
    agrees("Conv", x, w, b, group=groups, **window)
    back = {k: v for k, v in window.items() if k != "auto_pad"}
    agrees(
        "ConvTranspose",
        x,
        random.standard_normal((4, 3, *window["kernel_shape"])).astype(np.float32),
        **{**back, "dilations": (1, 1)},
    )


@settings(max_examples=40, deadline=None)
@given(window=windows(), seed=st.integers(0, 99), ceil=st.sampled_from([0, 1]), counted=st.sampled_from([0, 1]))
def test_pooling_agrees_with_onnx_runtime(window, seed, ceil, counted):
    """ONNX's own reference (1.23) is off where pads of the two sides differ, or windows are cut off with ceil_mode."""
    runtime = pytest.importorskip("onnxruntime")
    x = np.random.default_rng(seed).standard_normal((1, 2, 9, 11)).astype(np.float32)
    for op, more in (("MaxPool", {}), ("AveragePool", {"count_include_pad": counted, "dilations": (1, 1)})):
        attributes = {**window, "ceil_mode": ceil, **more}
        node = helper.make_node(op, ["x"], ["y"], **attributes)
        model = model_of([node], {"x": x.shape}, {"y": 4}, opset=19)
        (got,) = runtime.InferenceSession(model.SerializeToString()).run(None, {"x": x})
        ours, wide = Node(op, attributes, ("x",), ("y",)), [x.astype(float)]
        assert compare("y", ours, wide, got, compute(ours, wide, F32)[0]).ratio <= 1, attributes


@settings(max_examples=60, deadline=None)
@given(
    transform=st.sampled_from(["half_pixel", "pytorch_half_pixel", "align_corners", "asymmetric"]),
    mode=st.sampled_from(["linear", "nearest"]), rounding=st.sampled_from(["round_prefer_floor", "round_prefer_ceil", "floor", "ceil"]),
    sizes=st.tuples(st.integers(2, 14), st.integers(2, 14)), seed=st.integers(0, 9),
)  # fmt: skip
def test_resizing_agrees_with_onnx(transform, mode, rounding, sizes, seed):
    """Where they differ, ONNX's own is off: it rounds half_pixel's scale of sizes to float32 (onnx 1.23)."""
    x = np.random.default_rng(seed).standard_normal((1, 2, 6, 7)).astype(np.float32)
    agrees(
        "Resize", x, None, None, ints(1, 2, *sizes), mode=mode, coordinate_transformation_mode=transform, nearest_mode=rounding
    )


R = np.random.default_rng(3)
X = R.standard_normal((2, 4, 6, 6)).astype(np.float32)
C = np.abs(R.standard_normal(4)).astype(np.float32) + 0.5


@pytest.mark.parametrize(
    ("op", "arrays", "attributes"),
    [
        ("Add", (X, X[:1]), {}), ("Sub", (X, C[:, None, None]), {}), ("Mul", (X, X), {}), ("Div", (X, X + 9), {}), ("Relu", (X,), {}),
        ("LeakyRelu", (X,), {"alpha": 0.2}), ("PRelu", (X, C[:, None, None]), {}), ("Sigmoid", (X,), {}), ("Tanh", (X,), {}),
        ("Clip", (X, np.float32(-0.5), np.float32(0.5)), {}), ("HardSigmoid", (X,), {}), ("HardSwish", (X,), {}), ("Exp", (X,), {}),
        ("Sqrt", (np.abs(X),), {}), ("Abs", (X,), {}), ("Neg", (X,), {}), ("Max", (X, -X), {}), ("Min", (X, -X, X * 0), {}),
        ("Gemm", (X[0, 0], X[0, 1], C[0] * X[0, 2]), {"transA": 1, "transB": 1, "alpha": 0.5, "beta": 2.0}), ("MatMul", (X, X), {}),
        ("BatchNormalization", (X, C, C, C, C), {"epsilon": 1e-3}), ("Softmax", (X,), {"axis": 1}), ("Softmax", (X * 30,), {}),
        ("ReduceSum", (X, ints(1, 3)), {"keepdims": 0}), ("ReduceMean", (X, ints(2)), {}), ("ReduceMax", (X,), {}),
        ("ReduceMin", (X,), {}),
        ("ReduceL1", (X, ints(1)), {}), ("ReduceL2", (X, ints(1)), {}), ("ReduceSumSquare", (X, ints(-1)), {}),
        ("GlobalAveragePool", (X,), {}), ("GlobalMaxPool", (X,), {}), ("Concat", (X, X), {"axis": 1}),
        ("Slice", (X, ints(1, -2), ints(4, -9), ints(2, 3), ints(2, -1)), {}), ("Split", (X, ints(1, 3)), {"axis": 1, "outputs": 2}),
        ("Pad", (X, ints(0, 0, 1, 2, 0, 0, 2, 1), np.float32(7)), {}), ("Pad", (X, ints(0, 0, 1, 2, 0, 0, 2, 1)), {"mode": "reflect"}),
        ("Pad", (X, ints(0, 0, 1, 2, 0, 0, 2, 1)), {"mode": "edge"}), ("DepthToSpace", (X,), {"blocksize": 2, "mode": "CRD"}),
        ("DepthToSpace", (X,), {"blocksize": 2}), ("SpaceToDepth", (X,), {"blocksize": 2}), ("Transpose", (X,), {"perm": [0, 2, 3, 1]}),
        ("Reshape", (X, ints(0, -1, 12)), {}), ("Squeeze", (X[:1], ints(0)), {}), ("Unsqueeze", (X, ints(1)), {}),
        ("Flatten", (X,), {"axis": 2}),
        ("Gather", (X, ints(3, 0)), {"axis": 1}), ("Expand", (X[:, :1], ints(1, 4, 1, 1)), {}), ("Shape", (X,), {}),
        ("ConstantOfShape", (ints(2, 3),), {"value": onnx.numpy_helper.from_array(np.float32([0.5]))}), ("ConstantOfShape", (ints(4),), {}),
        ("Identity", (X,), {}),
        ("Cast", (X,), {"to": 10}), ("Cast", (X,), {"to": 7}),
    ],
)  # fmt: skip
def test_operators_agree_with_onnx(op, arrays, attributes):
    agrees(op, *arrays, **dict(attributes))


# A network with every kind of operator, and a port in NumPy in which mistakes are planted.


def network():
    def w(*shape):
        return (R.standard_normal(shape) / np.sqrt(np.prod(shape[1:]))).astype(np.float32)

    c = {
        "w1": w(8, 4, 3, 3), "b1": w(8, 1)[:, 0], "w2": w(8, 4, 3, 3), "w3": w(8, 6, 2, 3), "scale": C.repeat(2), "b": C.repeat(2),
        "mean": w(8, 1)[:, 0],
        "variance": C.repeat(2), "slope": np.abs(w(6, 1, 1)), "low": np.float32(-0.6), "high": np.float32(0.8),
        "scales": np.array([1, 1, 1.5, 2], np.float32),
        "starts": ints(1), "ends": ints(100), "axes": ints(3), "pads": ints(0, 0, 1, 0, 0, 0, 0, 2), "value": np.float32(0.25),
        "two": ints(2, 4),
        "flat": ints(0, 6, -1), "wg": w(24, 24), "bg": w(24, 1)[:, 0], "three": ints(3), "one": ints(1), "some": C[:1],
        "twice": np.array([1, 1, 2, 2], np.float32),
    }  # fmt: skip
    n = helper.make_node
    nodes = [
        n("Conv", ["x", "w1", "b1"], ["conv"], pads=[1, 0, 1, 2], strides=[1, 1]), n("Relu", ["conv"], ["relu"]),
        n("Conv", ["relu", "w2"], ["grouped"], group=2, dilations=[2, 1], pads=[2, 1, 2, 1], strides=[2, 2]),
        n("BatchNormalization", ["grouped", "scale", "b", "mean", "variance"], ["normal"], epsilon=1e-5),
        n("ConvTranspose", ["normal", "w3"], ["up"], strides=[2, 2], pads=[0, 1, 0, 0], output_padding=[1, 0]),
        n("PRelu", ["up", "slope"], ["prelu"]),
        n("LeakyRelu", ["prelu"], ["leaky"], alpha=0.1),
        n("MaxPool", ["leaky"], ["maximum"], kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 0, 0], ceil_mode=1),
        n("AveragePool", ["maximum"], ["average"], kernel_shape=[3, 3], pads=[1, 1, 1, 1]),
        n("Resize", ["average", "", "scales"], ["linear"], mode="linear"),
        n("Resize", ["linear", "",
        "twice"], ["nearest"], mode="nearest", coordinate_transformation_mode="asymmetric", nearest_mode="floor"),
        n("Pad", ["nearest", "pads", "value"], ["padded"]), n("Slice", ["padded", "starts", "ends", "axes"], ["sliced"]),
        n("Split", ["sliced", "two"], ["few", "many"], axis=1), n("Sigmoid", ["few"], ["gate"]), n("Tanh", ["many"], ["tanh"]),
        n("Concat", ["tanh", "gate"], ["joined"], axis=1), n("Clip", ["joined", "low", "high"], ["clipped"]),
        n("GlobalAveragePool", ["clipped"], ["global"]),
        n("Sub", ["clipped", "global"], ["centred"]), n("Softmax", ["centred"], ["soft"], axis=1),
        n("ReduceMean", ["soft", "axes"], ["rows"], keepdims=1),
        n("Div", ["soft", "rows"], ["shares"]), n("Transpose", ["shares"], ["turned"], perm=[0, 1, 3, 2]),
        n("Reshape", ["turned", "flat"], ["lines"]),
        n("Slice", ["lines", "one", "ends", "one"], ["five"]), n("MatMul", ["lines", "square"], ["product"]),
        n("Add", ["product", "some"], ["sum"]),
        n("Unsqueeze", ["x", "one"], ["deeper"]), n("Squeeze", ["deeper", "one"], ["same"]),
        n("SpaceToDepth", ["same"], ["deep"], blocksize=2),
        n("DepthToSpace", ["deep"], ["shuffled"], blocksize=2, mode="CRD"), n("Mul", ["shuffled", "x"], ["y"]),
        n("ReduceL2", ["y", "one"], ["length"], keepdims=1),
    ]  # fmt: skip
    c["square"] = w(315, 24)
    return model_of(nodes, {"x": [1, 4, 8, 10]}, {"sum": 3, "length": 4}, c)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("graph") / "network.onnx"
    onnx.save(network(), path)
    return load_model(path)


class NumpyPort:
    """The network in float32; ``plant`` changes the node that makes ``tensor``: from node and inputs to its results."""

    name = "numpy"

    def __init__(self, model, tensor="", plant=None):
        self.model, self.tensor, self.plant, self.last = model, tensor, plant, {}

    def run(self, inputs):
        values = {**self.model.constants, **inputs}
        for node in self.model.nodes:
            wide = [None if not n else values[n].astype(float) if values[n].dtype.kind == "f" else values[n] for n in node.inputs]
            results = self.plant(node, wide, self) if self.tensor in node.outputs else plain(node, wide)
            values |= {
                name: x.astype(np.float32) if x.dtype.kind == "f" else x for name, x in zip(node.outputs, results, strict=False)
            }
        return {name: values[name] for name in self.model.tensors}


def plain(node, inputs):
    return [result.x for result in compute(node, inputs, F32)]


def attributes(**changes):
    return lambda node, inputs, port: plain(replace(node, attributes={**node.attributes, **changes}), inputs)


def inputs(**changes):
    """``i1=lambda w: ...``: an input changed."""
    return lambda node, inputs, port: plain(
        node, [changes[f"i{k}"](a) if f"i{k}" in changes else a for k, a in enumerate(inputs)]
    )


def result(change):
    return lambda node, inputs, port: [change(x) for x in plain(node, inputs)]


def stale(node, inputs, port):
    outputs = plain(node, inputs)
    before, port.last = port.last or outputs, outputs
    return before


def last_column(x):
    return np.concatenate([x[..., :-1], x[..., -2:-1]], -1)


def half_sums(node, inputs, port):
    x = plain(node, inputs)[0]
    return [x + (np.abs(x).max() * 2.0**-10) * np.sin(np.arange(x.size)).reshape(x.shape)]


MISTAKES = [
    ("conv", attributes(pads=[1, 2, 1, 0])), ("conv", attributes(pads=[0, 0, 2, 2])), ("conv", inputs(i1=lambda w: w[..., ::-1])),
    ("conv", inputs(i1=lambda w: w.swapaxes(2, 3))), ("conv", inputs(i2=lambda b: b * 0)), ("conv", inputs(i1=lambda w: w[:, ::-1])),
    ("conv", inputs(i0=lambda x: np.roll(x, 1, -1))), ("conv", result(last_column)), ("conv", stale), ("conv", half_sums),
    ("conv", inputs(i0=lambda x: round_to(x, 2.0**-11), i1=lambda w: round_to(w, 2.0**-11))),
    ("conv", inputs(i0=lambda x: round_to(x, 2.0**-8))),
    ("conv", result(lambda x: round_to(x, 2.0**-11))), ("relu", result(lambda x: x + 1e-5)),
    ("grouped", attributes(dilations=[1, 2], pads=[1, 2, 1, 2])),
    ("grouped", inputs(i1=lambda w: np.roll(w, 4, 0))), ("grouped", inputs(i0=lambda x: np.roll(x, 4, 1))),
    ("grouped", inputs(i0=lambda x: x[:, [0, 2, 4, 6, 1, 3, 5, 7]])),
    ("grouped", inputs(i0=lambda x: np.roll(x, -1, -2))), ("normal", attributes(epsilon=1e-3)), ("normal", inputs(i4=np.sqrt)),
    ("normal", inputs(i3=lambda m: m * 0)),
    ("up", inputs(i1=lambda w: w[..., ::-1])), ("up", attributes(pads=[0, 0, 0, 1])), ("up", result(lambda x: np.roll(x, 1, -2))),
    ("prelu", inputs(i1=lambda s: s[::-1])), ("leaky", attributes(alpha=0.01)), ("maximum", attributes(pads=[0, 0, 1, 1])),
    ("maximum", inputs(i0=lambda x: np.maximum(x, 0))), ("average", attributes(count_include_pad=1)),
    ("linear", attributes(coordinate_transformation_mode="align_corners")),
    ("linear", attributes(coordinate_transformation_mode="asymmetric")), ("linear", attributes(mode="nearest")),
    ("nearest", attributes(nearest_mode="ceil")),
    ("nearest", attributes(coordinate_transformation_mode="half_pixel", nearest_mode="round_prefer_ceil", mode="linear")),
    ("padded", inputs(i2=lambda v: v * 0)),
    ("padded", attributes(mode="edge")), ("sliced", result(lambda x: np.roll(x, 1, -1))),
    ("few", lambda n, g, p: [x[:, ::-1] for x in plain(n, g)]),
    ("gate", result(lambda x: x * (1 + 2.0**-11))), ("tanh", result(lambda x: np.clip(x * 1.001, -1, 1))),
    ("joined", lambda n, g, p: plain(n, g[::-1])),
    ("clipped", inputs(i2=lambda v: v + 0.1)), ("global", result(lambda x: x * 0.99)), ("centred", result(lambda x: -x)),
    ("soft", attributes(axis=2)),
    ("soft", result(lambda x: x * (1 + 1e-4))), ("rows", result(lambda x: x[:, ::-1])),
    ("shares", result(lambda x: round_to(x, 2.0**-11))),
    ("turned", result(lambda x: x.reshape(x.shape[0], x.shape[1], x.shape[3], x.shape[2]).swapaxes(2, 3).reshape(x.shape))),
    ("lines", result(lambda x: x[..., ::-1])),
    ("product", result(lambda x: round_to(x, 2.0**-8))), ("sum", inputs(i1=lambda b: b * 0)),
    ("deep", result(lambda x: x.reshape(1, 4, 4, *x.shape[2:]).swapaxes(1, 2).reshape(x.shape))),
    ("shuffled", attributes(mode="DCR")), ("y", result(lambda x: x.swapaxes(2, 3).reshape(x.shape))), ("length", result(np.square)),
]  # fmt: skip


@pytest.mark.parametrize("number", every(3, range(len(MISTAKES))))
def test_a_mistake_is_found_at_its_tensor(model, number):
    tensor, plant = MISTAKES[number]
    outcome = judge_port(model, NumpyPort(model, tensor, plant), F32)
    assert re.match(rf"first departs at {tensor} ", outcome.wrong[0]), (number, outcome.wrong)


def test_a_right_port_passes(model):
    outcome = judge_port(model, NumpyPort(model), F32, tier="full")
    assert outcome.passes
    assert len(outcome.tensors) == len(model.tensors)
    assert max(tensor.ratio for tensor in outcome.ends.values()) < 0.5


@pytest.mark.parametrize(
    ("unit", "words"), [(2.0**-11, "half or TF32: operands rounded"), (2.0**-8, "bfloat16: operands rounded")]
)
def test_the_precision_of_one_layer_is_named(model, unit, words):
    plant = inputs(i0=lambda x: round_to(x, unit), i1=lambda w: round_to(w, unit))
    assert words in " ".join(judge_port(model, NumpyPort(model, "conv", plant), F32).wrong)


@pytest.mark.parametrize("dtype", ["float32", "float16"])
def test_a_right_engine_passes_where_the_bias_is_larger_than_the_sum(tmp_path, dtype):
    """The rounding of the last sum is then the whole error, in small inputs. A model of half is judged as half."""
    pytest.importorskip("onnxruntime")
    onnx.save(small_model(dtype), tmp_path / "m.onnx")
    outcome = CliRunner().invoke(conform, ["--onnx", str(tmp_path / "m.onnx"), "--port", "onnxruntime", "--tier", "full"])
    assert outcome.exit_code == 0, outcome.output


def test_outputs_alone_are_judged_from_the_inputs(model):
    class Outputs(NumpyPort):
        def run(self, inputs):
            return {name: super(Outputs, self).run(inputs)[name] for name in self.model.outputs}

    assert judge_port(model, Outputs(model), F32).passes
    wrong = judge_port(model, Outputs(model, "conv", attributes(pads=[1, 2, 1, 0])), F32).wrong
    assert "introduced here, or in nodes before it" in wrong[0]


@pytest.mark.parametrize("engine", ["onnxruntime", "openvino:f32"])
def test_engines_in_float32_pass(model, engine, tmp_path):
    pytest.importorskip(engine.partition(":")[0])
    words = [
        "--onnx",
        str(model.path),
        "--port",
        engine,
        "--json",
        str(tmp_path / "a.json"),
        "--junit",
        str(tmp_path / "a.xml"),
        "--report",
        str(tmp_path / "a.html"),
    ]
    outcome = CliRunner().invoke(conform, words)
    assert outcome.exit_code == 0, outcome.output
    data = json.loads((tmp_path / "a.json").read_text())
    schema = json.loads((Path(report.__file__).parents[1] / "report" / "schemas" / "graph-results.schema.json").read_text())
    jsonschema.validate(data, schema)
    assert data["passed"]
    assert 'failures="0"' in (tmp_path / "a.xml").read_text()
    assert "passes" in (tmp_path / "a.html").read_text()


def test_what_is_not_known_is_listed_and_the_part_before_it_judged(tmp_path):
    nodes = [helper.make_node("Relu", ["x"], ["y"]), helper.make_node("Det", ["y"], ["z"])]
    onnx.save(model_of(nodes, {"x": [1, 1, 3, 3]}, {"y": 4, "z": 2}), tmp_path / "m.onnx")
    model = load_model(tmp_path / "m.onnx")
    assert model.unknown == ("node 1 (Det): operator Det",)
    assert model.tensors == ["y"]

    class Port:
        name = "p"

        def run(self, inputs):
            return {"y": inputs["x"] * (inputs["x"] > 0), "z": np.zeros((1, 1), np.float32)}

    outcome = judge_port(model, Port(), F32)
    assert (outcome.passes, outcome.unjudged) == (True, ("z",))
    assert "not judged: output z" in report.lines_of(outcome)

    class Nothing(Port):
        def run(self, inputs):
            return {"z": np.zeros((1, 1), np.float32)}

    onnx.save(model_of(nodes, {"x": [1, 1, 3, 3]}, {"z": 2}), tmp_path / "m.onnx")
    outcome = judge_port(load_model(tmp_path / "m.onnx"), Nothing(), F32)
    assert (outcome.passes, outcome.wrong) == (False, ("nothing was judged",))


def test_an_output_may_be_without_a_shape(tmp_path):
    """Other exporters than PyTorch's leave it out."""
    proto = small_model(np.float32)
    proto.graph.output[0].type.tensor_type.ClearField("shape")
    onnx.save(proto, tmp_path / "m.onnx")
    model = load_model(tmp_path / "m.onnx")
    assert judge_port(model, NumpyPort(model), F32).passes


def test_a_bad_file_is_one_line(tmp_path):
    (tmp_path / "bad.onnx").write_bytes(b"\x08\x01\x12junk")
    outcome = CliRunner().invoke(conform, ["--onnx", str(tmp_path / "bad.onnx"), "--port", "onnxruntime"])
    assert "not an ONNX model" in str(outcome.exception)
    assert "\n" not in str(outcome.exception)


def test_another_opset_is_refused(tmp_path):
    onnx.save(model_of([helper.make_node("Relu", ["x"], ["y"])], {"x": [1]}, {"y": 1}, opset=11), tmp_path / "old.onnx")
    outcome = CliRunner().invoke(conform, ["--onnx", str(tmp_path / "old.onnx"), "--port", "onnxruntime"])
    assert "expected opset 13 to 22, found 11" in str(outcome.exception)


@pytest.mark.parametrize(
    ("run", "words"),
    [
        (lambda inputs: {"sum": np.zeros((1, 2), np.float32), "length": np.zeros((1, 1, 8, 10), np.float32)}, "expected shape"),
        (lambda inputs: {}, "output sum is missing"), (lambda inputs: 1 / 0, "ZeroDivisionError"),
        (lambda inputs: None, "TypeError"), (lambda inputs: {"sum": [1.0], "length": 0}, "sum: expected an array of numbers, got list"),
        (lambda inputs: {"sum": inputs["x"].astype(complex), "length": 0}, "sum: expected an array of numbers, got complex128"),
        (lambda inputs: {"sum": inputs["x"].astype(object), "length": 0}, "sum: expected an array of numbers, got object"),
        (lambda inputs: {"sum": inputs["x"], "length": inputs["x"], "tanh": "text"}, "tanh: expected an array of numbers, got str"),
    ],
)  # fmt: skip
def test_a_port_that_answers_otherwise_is_said(model, run, words):
    port = NumpyPort(model)
    port.run = run
    assert words in " ".join(judge_port(model, port, F32).wrong)


def test_layers_of_another_run_are_judged_beside_the_outputs(model):
    class Layered(NumpyPort):
        def run(self, inputs):
            return {name: array for name, array in super().run(inputs).items() if name in model.outputs}

        def layers(self, inputs):
            return NumpyPort.run(self, inputs)

    outcome = judge_port(model, Layered(model), F32)
    assert (outcome.passes, [*outcome.tensors]) == (True, model.tensors)
    wrong = judge_port(model, Layered(model, "conv", attributes(pads=[1, 2, 1, 0])), F32).wrong
    assert re.match("first departs at conv .* introduced here$", wrong[0])


def test_a_port_forgets_its_state_before_each_smaller_case(model):
    class Counting(NumpyPort):
        restarts = 0

        def restart(self):
            self.restarts += 1

    port = Counting(model, "tanh", result(lambda x: x + 1))
    assert not judge_port(model, port, F32).passes
    assert port.restarts > 0


def test_an_ability_that_cannot_be_read_is_the_ports_mistake(model):
    class Broken(NumpyPort):
        @property
        def layers(self):
            raise RuntimeError("no layers today")

    with pytest.raises(InputError, match="RuntimeError: no layers today"):
        judge_port(model, Broken(model), F32)


def test_nan_is_wrong(model):
    plant = result(lambda x: np.where(np.arange(x.size).reshape(x.shape) == 3, np.nan, x))
    wrong = judge_port(model, NumpyPort(model, "tanh", plant), F32).wrong[0]
    assert re.match("first departs at tanh .* error / bound inf, rms / bound inf", wrong)


def test_a_program_is_judged_by_its_job_folder(tmp_path):
    """With names that no file has: a slash is percent-encoded."""
    nodes = [helper.make_node("Relu", ["in/x"], ["a/b"]), helper.make_node("Neg", ["a/b"], ["y"])]
    onnx.save(model_of(nodes, {"in/x": [1, 2, 3, 3]}, {"y": 4}), tmp_path / "m.onnx")
    (tmp_path / "port.py").write_text(
        "import sys, pathlib, numpy as np\n"
        "case = pathlib.Path(sys.argv[1]) / '0000'\n"
        "(case / 'out').mkdir()\n"
        "x = np.maximum(np.load(case / 'in' / 'in%2Fx.npy'), 0)\n"
        "np.save(case / 'out' / 'a%2Fb.npy', x)\n"
        "np.save(case / 'out' / 'y.npy', -x)\n"
    )
    command = f"{sys.executable} {tmp_path / 'port.py'}"
    outcome = CliRunner().invoke(conform, ["--onnx", str(tmp_path / "m.onnx"), "--exec", command])
    assert outcome.exit_code == 0, outcome.output
    assert "2 tensors judged" in outcome.output


ONE_NODE_PORT = """
import numpy as np
class Port:
    name = "p"
    def run(self, inputs):
        return {"y/1": np.maximum(inputs["x"], 0) * np.float32(FACTOR)}
class Keeps(Port):
    def __init__(self):
        self.calls = 0
    def run(self, inputs):
        self.calls += 1
        outputs = super().run(inputs)
        return {"y/1": outputs["y/1"] + (self.calls == 3)}
"""


@pytest.fixture
def one_node(tmp_path, monkeypatch):
    """A model of one node, and ports of it in a file."""
    onnx.save(model_of([helper.make_node("Relu", ["x"], ["y/1"])], {"x": [1, 2, 4, 6]}, {"y/1": 4}), tmp_path / "m.onnx")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))

    def invoke(factor, *words):
        sys.modules.pop("one_node_port", None)
        (tmp_path / "one_node_port.py").write_text(ONE_NODE_PORT.replace("FACTOR", str(factor)))
        importlib.invalidate_caches()
        return CliRunner().invoke(conform, ["--onnx", "m.onnx", "--port", "one_node_port:Port", *words])

    return invoke


def test_a_failure_is_kept_and_run_again(one_node, tmp_path):
    """As of ports of STSS: the smallest case with the right answer, its picture, and the command that runs it again."""
    outcome = one_node(1.001, "--json", "a.json", "--junit", "a.xml", "--report", "a.html")
    again = "stss conform --onnx m.onnx --port one_node_port:Port --replay conform-failures/m.onnx"
    assert (outcome.exit_code, again in outcome.output) == (1, True)
    folder = tmp_path / "conform-failures" / "m.onnx"
    assert again in (folder / "README.txt").read_text()
    assert "first departs at y/1 (Relu)" in (folder / "README.txt").read_text()
    got, right, allowed = (
        np.load(folder / "0000" / part) for part in ("got/y%2F1.npy", "expected/y%2F1.0.npy", "allowed/y%2F1.npy")
    )
    x = np.load(folder / "0000" / "in" / "x.npy")
    assert np.array_equal(right, np.maximum(x, 0))
    assert np.array_equal(got, np.maximum(x, 0) * np.float32(1.001))
    assert allowed.max() <= np.finfo(np.float32).tiny
    assert (folder / "picture.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((tmp_path / "a.json").read_text())["failure"] == "conform-failures/m.onnx"
    assert again in (tmp_path / "a.xml").read_text()
    assert "data:image/png" in (tmp_path / "a.html").read_text()

    words = ["--replay", "conform-failures/m.onnx"]
    wrong, right = one_node(1.001, *words), one_node(1, *words)
    assert (wrong.exit_code, right.exit_code) == (1, 0)
    assert "case: as given" in wrong.output
    assert "1 cases, 1 tensors judged" in right.output


def test_what_a_port_keeps_from_call_to_call_fails_again(one_node, tmp_path):
    """It is right on the failing case alone, so those before it are kept, too."""
    assert one_node(1).exit_code == 0
    words = ["--onnx", "m.onnx", "--port", "one_node_port:Keeps"]
    outcome = CliRunner().invoke(conform, words)
    assert "keeps state from call to call" in outcome.output
    assert len(read_drawn(tmp_path / "conform-failures" / "m.onnx" / "property")[1]) == 3
    assert CliRunner().invoke(conform, [*words, "--replay", "conform-failures/m.onnx"]).exit_code == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--stages", "warp"], "--stages: not with --onnx"), (["--repeat", "2"], "--repeat: not with --onnx"),
        (["--fail-fast"], "--fail-fast: not with --onnx"), (["--replay", "nowhere"], "expected the folder of one failure"),
        (["--input", "x=nowhere.npy"], "missing"), (["--input", "z=a.npy", "--input", "x=a.npy"], "expected x, got z"),
        (["--input", "x=a.npy"], "expected float32 (1, 2, 4, 6), found float32 (3,)"), (["--shape", "n=0"], "expected NAME=N"),
    ],
)  # fmt: skip
def test_options_that_do_not_fit_are_one_line(one_node, tmp_path, words, message):
    np.save(tmp_path / "a.npy", np.zeros(3, np.float32))
    outcome = one_node(1, *words)
    assert message in str(outcome.exception)
    assert "\n" not in str(outcome.exception)


def test_options_of_any_network_need_one():
    assert "--shape: only with --onnx" in str(CliRunner().invoke(conform, ["--port", "a:b", "--shape", "n=3"]).exception)


def test_a_program_that_changes_its_inputs_or_fails_is_said(tmp_path):
    """`Program` makes the same checks as for ports of STSS."""
    onnx.save(model_of([helper.make_node("Relu", ["x"], ["y"])], {"x": [3]}, {"y": 1}), tmp_path / "m.onnx")
    model = load_model(tmp_path / "m.onnx")
    for lines, limit, words in (
        ("import shutil; shutil.rmtree(case / 'in')", 60, "a program leaves its inputs as they are"),
        ("print('no device', file=sys.stderr); sys.exit(3)", 60, "no device"),
        ("import time; time.sleep(60)", 0.5, "stopped after 0.5 s"),
    ):
        (tmp_path / "port.py").write_text(f"import sys, pathlib\ncase = pathlib.Path(sys.argv[1]) / '0000'\n{lines}\n")
        port = load_graph_port(model, PortChoice(program=f"{sys.executable} {tmp_path / 'port.py'}", timeout=limit))
        assert words in " ".join(judge_port(model, port, F32).wrong)


def test_a_ports_source_is_not_replaced_by_a_report(tmp_path, monkeypatch):
    onnx.save(model_of([helper.make_node("Relu", ["x"], ["y"])], {"x": [3]}, {"y": 1}), tmp_path / "m.onnx")
    source = "class Port:\n    name = 'p'\n    def run(self, inputs):\n        return {'y': inputs['x'] * (inputs['x'] > 0)}\n"
    (tmp_path / "own_graph_port.py").write_text(source)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    words = ["--onnx", "m.onnx", "--port", "own_graph_port:Port"]
    assert CliRunner().invoke(conform, words).exit_code == 0
    outcome = CliRunner().invoke(conform, [*words, "--report", "own_graph_port.py"])
    assert outcome.exit_code != 0
    assert "own_graph_port.py" in str(outcome.exception)
    assert (tmp_path / "own_graph_port.py").read_text() == source
