# SPDX-License-Identifier: MIT
"""The operators of image networks in ONNX, opset 13 to 22: each in float64, with the error that a port's rounding can cause.

The definitions are those of ONNX's documentation. An operator takes the rounding, its node and its inputs (None: left out).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from conformance.answers.port_arithmetic import Arithmetic
from conformance.graph.rounding import AnyArray, Result, Rounding
from conformance.graph.windows import TRANSFORMATIONS, Window, coordinates, nearest
from conformance.tolerance import BOUNDS
from stss_ref.conv import sigmoid


@dataclass(frozen=True)
class Node:
    """A node: the operator's name, its attributes, and the names of its tensors."""

    op: str
    attributes: Mapping[str, Any]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def get(self, name: str, default: Any = None) -> Any:
        """An attribute."""
        return self.attributes.get(name, default)


class UnsupportedError(ValueError):
    """The operator is known, but not with these attributes."""


Operator = Callable[..., Result | tuple[Result, ...]]
OPERATORS: dict[str, Operator] = {}
"""Operator -> function of rounding, node and inputs: float64 arrays, integers, or None for one that is left out."""


def _operator(*names: str) -> Callable[[Operator], Operator]:
    def add(function: Operator) -> Operator:
        OPERATORS.update(dict.fromkeys(names, function))
        return function

    return add


def _whole(value: AnyArray | None) -> list[int] | None:
    """A tensor of integers, such as axes."""
    return None if value is None or value.size == 0 else [int(i) for i in np.atleast_1d(value)]


def _axes(node: Node, value: AnyArray | None, rank: int) -> tuple[int, ...]:
    """Axes, by attribute in old opsets and by input in new ones; none: all."""
    axes = node.get("axes") if value is None else _whole(value)
    return tuple(range(rank)) if not axes else tuple(int(axis) % rank for axis in axes)


# Sums of products


@_operator("Conv")
def _conv(r: Rounding, node: Node, x: AnyArray, w: AnyArray, b: AnyArray | None = None) -> Result:
    window = window_of(node, x.shape[2:], w.shape[2:])
    groups, terms = node.get("group", 1), math.prod(w.shape[1:]) + 2
    result = r.products(lambda a, k: window.convolve(a, k, groups), x, w, terms)
    if r.arithmetic.winograd and w.ndim == 4 and min(w.shape[2:]) > 1 and max(window.strides + window.dilations) == 1:
        # Winograd mixes the taps of a window, so that each tap bears the others' rounding errors.
        mixed = np.broadcast_to(np.abs(w).max(axis=(2, 3), keepdims=True), w.shape)
        widen = r.gamma(BOUNDS["layer.winograd"].roundings * terms)
        result = Result(result.x, result.e + widen * window.convolve(np.abs(x), mixed, groups), terms)
    return _add_bias(r, result, b)


def _add_bias(r: Rounding, result: Result, b: AnyArray | None) -> Result:
    if b is None:
        return result
    x = result.x + b.reshape(-1, *[1] * (result.x.ndim - 2))
    last = r.unit * (np.abs(x) + result.e)
    usual = result.e / np.sqrt(result.terms) + last  # one rounding is no random walk, and may be larger than all of the sum's
    return Result(x, result.e + last, ((result.e + last) / usual) ** 2)


def window_of(node: Node, size: Sequence[int], kernel: Sequence[int]) -> Window:
    """The window of a convolution or a pooling over an input of ``size``."""
    n = len(size)
    kernel, strides, dilations = node.get("kernel_shape", kernel), node.get("strides", [1] * n), node.get("dilations", [1] * n)
    pads, auto, ceil = node.get("pads", [0] * 2 * n), node.get("auto_pad", "NOTSET"), bool(node.get("ceil_mode", 0))
    return Window(size, kernel, strides, dilations, pads, auto, ceil=ceil)


@_operator("ConvTranspose")
def _conv_transpose(r: Rounding, node: Node, x: AnyArray, w: AnyArray, b: AnyArray | None = None) -> Result:
    n, groups, kernel = x.ndim - 2, node.get("group", 1), w.shape[2:]
    strides, dilations = node.get("strides", [1] * n), node.get("dilations", [1] * n)
    extra, pads, shape = node.get("output_padding", [0] * n), node.get("pads", [0] * 2 * n), node.get("output_shape")
    auto = node.get("auto_pad", "NOTSET")
    whole = [(x.shape[2 + i] - 1) * strides[i] + extra[i] + (kernel[i] - 1) * dilations[i] + 1 for i in range(n)]
    if shape is not None or auto in ("SAME_UPPER", "SAME_LOWER"):
        shape = [x.shape[2 + i] * strides[i] for i in range(n)] if shape is None else [*shape[-n:]]
        total = [max(a - s, 0) for a, s in zip(whole, shape, strict=True)]
        half = [t // 2 if auto == "SAME_UPPER" else t - t // 2 for t in total]
        pads = [*half, *(t - h for t, h in zip(total, half, strict=True))]
    size = [whole[i] - pads[i] - pads[n + i] for i in range(n)]
    window = Window(size, kernel, strides, dilations, pads)
    window.out = [*x.shape[2:]]
    terms = w.shape[0] // groups * math.prod(kernel) + 2
    return _add_bias(r, r.products(lambda a, k: window.spread(a, k, groups, size), x, w, terms), b)


@_operator("Gemm")
def _gemm(r: Rounding, node: Node, a: AnyArray, b: AnyArray, c: AnyArray | None = None) -> Result:
    a, b = (v.T if node.get(f"trans{k}", 0) else v for v, k in ((a, "A"), (b, "B")))
    alpha, beta = float(np.float32(node.get("alpha", 1.0))), float(np.float32(node.get("beta", 1.0)))
    rest = 0.0 if c is None else beta * c
    x = alpha * (a @ b) + rest
    return r.lose(x, a.shape[1] + 4, abs(alpha) * (np.abs(a) @ np.abs(b)) + np.abs(rest))


@_operator("MatMul")
def _matmul(r: Rounding, _: Node, a: AnyArray, b: AnyArray) -> Result:
    return r.products(np.matmul, a, b, a.shape[-1] + 1)


# Elementwise


def _arithmetic(name: str, function: Callable[[AnyArray, AnyArray], AnyArray], roundings: float) -> None:
    @_operator(name)
    def apply(r: Rounding, _: Node, a: AnyArray, b: AnyArray) -> Result:
        x = function(a, b)
        if x.dtype.kind in "iu" or a.dtype.kind in "iu":
            return Result((np.trunc(x) if name == "Div" else x).astype(a.dtype))
        return r.lose(x, roundings)

    del apply


_arithmetic("Add", np.add, 1)
_arithmetic("Sub", np.subtract, 1)
_arithmetic("Mul", np.multiply, 1)
_arithmetic("Div", np.divide, BOUNDS["graph.division"].roundings)


def _function(name: str, function: Callable[[AnyArray], AnyArray], roundings: float, *, of_one: bool = False) -> None:
    """A function that rounds relatively, or (``of_one``) as numbers of size 1; with 0 roundings only small numbers may become 0."""

    @_operator(name)
    def apply(r: Rounding, _: Node, x: AnyArray) -> Result:
        return r.lose(function(x), roundings, 1.0 if of_one else None)

    del apply


_function("Relu", lambda x: np.maximum(x, 0), 0)
_function("Abs", np.abs, 0)
_function("Neg", np.negative, 0)
_function("Sigmoid", sigmoid, BOUNDS["gate"].roundings, of_one=True)
_function("Tanh", np.tanh, BOUNDS["gate"].roundings, of_one=True)
_function("Sqrt", lambda x: np.sqrt(np.maximum(x, 0)), BOUNDS["graph.division"].roundings)
_function("Exp", np.exp, BOUNDS["gate"].roundings)


@_operator("Identity", "Dropout")
def _identity(_r: Rounding, _: Node, x: AnyArray, *_rest: AnyArray) -> Result:
    return Result(x)


@_operator("LeakyRelu")
def _leaky(r: Rounding, node: Node, x: AnyArray) -> Result:
    return r.lose(np.where(x < 0, float(np.float32(node.get("alpha", 0.01))) * x, x), 1)


@_operator("PRelu")
def _prelu(r: Rounding, _: Node, x: AnyArray, slope: AnyArray) -> Result:
    return r.lose(np.where(x < 0, slope * x, x), 1)


@_operator("HardSigmoid", "HardSwish")
def _hard(r: Rounding, node: Node, x: AnyArray) -> Result:
    alpha, beta = (1 / 6, 0.5) if node.op == "HardSwish" else (node.get("alpha", 0.2), node.get("beta", 0.5))
    size = np.abs(alpha * x) + abs(beta)
    gate = np.clip(alpha * x + beta, 0, 1)
    return r.lose(gate, 3, size) if node.op == "HardSigmoid" else r.lose(x * gate, 4, size * np.abs(x))


@_operator("Clip")
def _clip(r: Rounding, _: Node, x: AnyArray, low: AnyArray | None = None, high: AnyArray | None = None) -> Result:
    x = np.maximum(x, low) if low is not None else x
    return r.lose(np.minimum(x, high) if high is not None else x, 0)


@_operator("Max", "Min")
def _extreme(r: Rounding, node: Node, *some: AnyArray) -> Result:
    pick = np.maximum if node.op == "Max" else np.minimum
    x = some[0]
    for each in some[1:]:
        x = pick(x, each)
    return r.lose(x, 0)


@_operator("BatchNormalization")
def _normalise(r: Rounding, node: Node, x: AnyArray, scale: AnyArray, b: AnyArray, mean: AnyArray, variance: AnyArray) -> Result:
    if node.get("training_mode", 0):
        raise UnsupportedError("training_mode 1")
    shape = (-1, *[1] * (x.ndim - 2))
    factor = (scale / np.sqrt(variance + float(np.float32(node.get("epsilon", 1e-5))))).reshape(shape)
    m, bias = mean.reshape(shape), b.reshape(shape)
    size = (np.abs(x) + np.abs(m)) * np.abs(factor) + np.abs(bias)
    return r.lose((x - m) * factor + bias, BOUNDS["graph.normalise"].roundings, size)


@_operator("Softmax")
def _softmax(r: Rounding, node: Node, x: AnyArray) -> Result:
    axis = node.get("axis", -1)
    off = x - x.max(axis=axis, keepdims=True)
    y = np.exp(off)
    y = y / y.sum(axis=axis, keepdims=True)
    # exp(a - b) turns the rounding of a - b into as much of a relative error; the sum has n terms.
    return r.lose(y, 1, (np.abs(off) + x.shape[axis] + 2 * BOUNDS["gate"].roundings) * y)


@_operator("Cast")
def _cast(_r: Rounding, node: Node, x: AnyArray) -> Result:
    kinds = {1: np.float64, 11: np.float64, 6: np.int32, 7: np.int64, 9: np.bool_, 2: np.uint8, 3: np.int8}
    to = node.get("to")
    if to in (10, 16):
        arithmetic = Arithmetic("float16" if to == 10 else "bfloat16")
        return Result(x.astype(np.float64), arithmetic.unit * np.abs(x) + arithmetic.spacing)
    if to not in kinds:
        raise UnsupportedError(f"to {to}")
    return Result(x.astype(kinds[to]))


# Sums and extremes over axes and windows


@_operator("ReduceSum", "ReduceMean", "ReduceMax", "ReduceMin", "ReduceL1", "ReduceL2", "ReduceSumSquare")
def _reduce(r: Rounding, node: Node, x: AnyArray, axes: AnyArray | None = None) -> Result:
    if axes is None and node.get("axes") is None and node.get("noop_with_empty_axes", 0):
        return Result(x)
    return _reduce_over(r, node.op.removeprefix("Reduce"), x, _axes(node, axes, x.ndim), keep=bool(node.get("keepdims", 1)))


def _reduce_over(r: Rounding, kind: str, x: AnyArray, over: tuple[int, ...], *, keep: bool) -> Result:
    n = math.prod(x.shape[axis] for axis in over)

    def total(a: AnyArray) -> AnyArray:
        return a.sum(axis=over, keepdims=keep)

    if kind in ("Max", "Min"):
        return r.lose((np.max if kind == "Max" else np.min)(x, axis=over, keepdims=keep), 0)
    if kind == "L2":
        return r.lose(np.sqrt(total(x * x)), n / 2 + 1 + BOUNDS["graph.division"].roundings)
    if kind in ("L1", "SumSquare"):
        return r.lose(total(np.abs(x) if kind == "L1" else x * x), n + 1)
    result = r.sums(total, x, n)
    return result if kind == "Sum" else Result(result.x / n, result.e / n + 2 * r.unit * np.abs(result.x / n))


@_operator("GlobalAveragePool", "GlobalMaxPool")
def _global(r: Rounding, node: Node, x: AnyArray) -> Result:
    return _reduce_over(r, "Mean" if "Average" in node.op else "Max", x, tuple(range(2, x.ndim)), keep=True)


@_operator("MaxPool")
def _max_pool(r: Rounding, node: Node, x: AnyArray) -> Result:
    if len([name for name in node.outputs if name]) > 1:
        raise UnsupportedError("output Indices")
    window = window_of(node, x.shape[2:], ())
    return r.lose(np.max([there for _, there in window.taps(window.pad(x, -np.inf))], axis=0), 0)


@_operator("AveragePool")
def _average_pool(r: Rounding, node: Node, x: AnyArray) -> Result:
    window = window_of(node, x.shape[2:], ())

    def total(a: AnyArray) -> AnyArray:
        return np.sum([there for _, there in window.taps(window.pad(a))], axis=0)

    ones = np.ones((1, 1, *x.shape[2:]))
    number = (
        np.sum([there for _, there in window.taps(window.pad_counted(ones))], 0)
        if node.get("count_include_pad", 0)
        else total(ones)
    )
    result = r.sums(total, x, math.prod(window.kernel))
    return Result(result.x / number, result.e / number + 2 * r.unit * np.abs(result.x / number))


@_operator("Resize")
def _resize(
    r: Rounding,
    node: Node,
    x: AnyArray,
    _roi: AnyArray | None = None,
    scales: AnyArray | None = None,
    sizes: AnyArray | None = None,
) -> Result:
    mode, transform, antialias = (
        node.get(*each) for each in (("mode", "nearest"), ("coordinate_transformation_mode", "half_pixel"), ("antialias", 0))
    )
    if mode not in ("nearest", "linear") or transform not in TRANSFORMATIONS or antialias:
        raise UnsupportedError(f"mode {mode}, coordinate_transformation_mode {transform}, antialias {antialias}")
    if node.get("keep_aspect_ratio_policy", "stretch") != "stretch":
        raise UnsupportedError("keep_aspect_ratio_policy")
    lengths = _whole(sizes)
    result = Result(x)
    for i, axis in enumerate(node.get("axes") or range(x.ndim)):
        before = x.shape[axis]
        scale = lengths[i] / before if lengths else float(np.atleast_1d(scales)[i]) if scales is not None else 1.0
        after = lengths[i] if lengths else math.floor(before * scale)
        if after != before or scale != 1:
            at = coordinates(transform, after, before, scale)
            result = (
                _pick(r, result, axis, at, node.get("nearest_mode", "round_prefer_floor"))
                if mode == "nearest"
                else _lerp(r, result, axis, at)
            )
    return result


def _pick(r: Rounding, result: Result, axis: int, at: AnyArray, mode: str) -> Result:
    """The nearest numbers; where rounding a coordinate decides, either neighbour is right."""
    off = np.where(at % 0.5 != 0, BOUNDS["graph.coordinate"].roundings * r.unit * (np.abs(at) + 1), 0)
    last = result.x.shape[axis] - 1
    index, low, high = (np.clip(nearest(place, mode), 0, last).astype(int) for place in (at, at - off, at + off))
    x = np.take(result.x, index, axis)
    unsure = np.maximum(*(np.abs(np.take(result.x, other, axis) - x) for other in (low, high)))
    return Result(x, np.take(result.errors, index, axis) + unsure)


def _lerp(r: Rounding, result: Result, axis: int, at: AnyArray) -> Result:
    last = result.x.shape[axis] - 1
    place = np.clip(at, 0, last)
    low = np.minimum(np.floor(place).astype(int), max(last - 1, 0))
    shape = [-1 if i == axis else 1 for i in range(result.x.ndim)]
    t = (place - low).reshape(shape)

    def apply(a: AnyArray) -> AnyArray:
        return np.take(a, low, axis) * (1 - t) + np.take(a, np.minimum(low + 1, last), axis) * t

    off = (BOUNDS["graph.coordinate"].roundings * r.unit * (np.abs(at) + 1)).reshape(shape)
    taps = [np.take(result.x, np.clip(low + i, 0, last), axis) for i in (-1, 0, 1, 2)]
    steep = np.max([np.abs(b - a) for a, b in pairwise(taps)], axis=0)
    blended = r.sums(apply, result.x, BOUNDS["graph.lerp"].roundings)
    return Result(blended.x, blended.e + off * steep + apply(result.errors))


# Numbers in other places


@_operator("Concat")
def _concat(_r: Rounding, node: Node, *some: AnyArray) -> Result:
    return Result(np.concatenate(some, node.get("axis")))


@_operator("Slice")
def _slice(
    _r: Rounding,
    _: Node,
    x: AnyArray,
    starts: AnyArray,
    ends: AnyArray,
    axes: AnyArray | None = None,
    steps: AnyArray | None = None,
) -> Result:
    first, last = _whole(starts) or [], _whole(ends) or []
    over, by = _whole(axes) or [*range(len(first))], _whole(steps) or [1] * len(first)
    index = [slice(None)] * x.ndim
    for axis, start, end, step in zip(over, first, last, by, strict=True):
        length, top = x.shape[axis], x.shape[axis] if step > 0 else x.shape[axis] - 1
        begin, stop = (n + length if n < 0 else n for n in (start, end))
        begin = min(max(begin, 0), top)
        index[axis] = slice(begin, min(max(stop, 0), length) if step > 0 else None if stop < 0 else stop, step)
    return Result(x[tuple(index)])


@_operator("Split")
def _split(_r: Rounding, node: Node, x: AnyArray, parts: AnyArray | None = None) -> tuple[Result, ...]:
    axis, n = node.get("axis", 0), len(node.outputs)
    each = -(-x.shape[axis] // n)
    sizes = _whole(parts) or [*[each] * (n - 1), x.shape[axis] - each * (n - 1)]
    return tuple(map(Result, np.split(x, np.cumsum(sizes)[:-1], axis)))


@_operator("Pad")
def _pad(
    _r: Rounding, node: Node, x: AnyArray, pads: AnyArray, value: AnyArray | None = None, axes: AnyArray | None = None
) -> Result:
    amounts, over, mode = _whole(pads) or [], _axes(node, axes, x.ndim), node.get("mode", "constant")
    around = [(0, 0)] * x.ndim
    for i, axis in enumerate(over):
        around[axis] = amounts[i], amounts[len(over) + i]
    cut = x[tuple(slice(max(-a, 0), n - max(-b, 0)) for (a, b), n in zip(around, x.shape, strict=True))]
    outer = [(max(a, 0), max(b, 0)) for a, b in around]
    if mode == "constant":
        return Result(np.pad(cut, outer, constant_values=0.0 if value is None or value.size == 0 else value.item()))
    return Result(np.pad(cut, outer, mode="edge" if mode == "edge" else "reflect" if mode == "reflect" else "wrap"))


@_operator("Transpose")
def _transpose(_r: Rounding, node: Node, x: AnyArray) -> Result:
    return Result(x.transpose(node.get("perm") or [*range(x.ndim)][::-1]))


@_operator("Reshape")
def _reshape(_r: Rounding, node: Node, x: AnyArray, shape: AnyArray) -> Result:
    return Result(
        x.reshape([x.shape[i] if n == 0 and not node.get("allowzero", 0) else n for i, n in enumerate(_whole(shape) or [])])
    )


@_operator("Squeeze")
def _squeeze(_r: Rounding, node: Node, x: AnyArray, axes: AnyArray | None = None) -> Result:
    return Result(np.squeeze(x, None if axes is None and node.get("axes") is None else _axes(node, axes, x.ndim)))


@_operator("Unsqueeze")
def _unsqueeze(_r: Rounding, node: Node, x: AnyArray, axes: AnyArray | None = None) -> Result:
    return Result(np.expand_dims(x, tuple((node.get("axes") if axes is None else _whole(axes)) or ())))


@_operator("Flatten")
def _flatten(_r: Rounding, node: Node, x: AnyArray) -> Result:
    axis = node.get("axis", 1)
    return Result(x.reshape(math.prod(x.shape[: axis + x.ndim if axis < 0 else axis]), -1))


@_operator("DepthToSpace", "SpaceToDepth")
def _shuffle(_r: Rounding, node: Node, x: AnyArray) -> Result:
    (n, c, h, w), b = x.shape, node.get("blocksize")
    if node.op == "SpaceToDepth":
        return Result(x.reshape(n, c, h // b, b, w // b, b).transpose(0, 3, 5, 1, 2, 4).reshape(n, c * b * b, h // b, w // b))
    if node.get("mode", "DCR") == "DCR":
        parts = x.reshape(n, b, b, c // b**2, h, w).transpose(0, 3, 4, 1, 5, 2)
    else:
        parts = x.reshape(n, c // b**2, b, b, h, w).transpose(0, 1, 4, 2, 5, 3)
    return Result(parts.reshape(n, c // b**2, h * b, w * b))


@_operator("Gather")
def _gather(_r: Rounding, node: Node, x: AnyArray, index: AnyArray) -> Result:
    return Result(np.take(x, index, node.get("axis", 0)))


@_operator("Expand")
def _expand(_r: Rounding, _: Node, x: AnyArray, shape: AnyArray) -> Result:
    return Result(x * np.ones(_whole(shape) or (), x.dtype))


@_operator("Shape")
def _shape(_r: Rounding, node: Node, x: AnyArray) -> Result:
    return Result(np.array(x.shape[node.get("start", 0) : node.get("end")], np.int64))


@_operator("ConstantOfShape")
def _fill(_r: Rounding, node: Node, shape: AnyArray) -> Result:
    value = np.asarray(node.get("value", np.zeros(1)))
    return Result(np.full(_whole(shape) or (), value.item(), np.float64 if value.dtype.kind == "f" else value.dtype))


@_operator("Constant")
def _constant(_r: Rounding, node: Node) -> Result:
    (value,) = node.attributes.values()
    array = np.asarray(value)
    return Result(array.astype(np.float64) if array.dtype.kind == "f" else array)
