# SPDX-License-Identifier: MIT
"""Compare a port's tensors with the model's, each from the port's own tensors before it: so an error is found at its node."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from conformance.answers.network import TAIL
from conformance.graph.model import Model
from conformance.graph.operators import OPERATORS, Node, UnsupportedError, window_of
from conformance.graph.rounding import AnyArray, Result, Rounding
from conformance.tolerance import BOUNDS, worst

Arrays = Mapping[str, AnyArray]
RUNS = 3
"""Runs with random changes, for a tensor that depends on tensors that the port did not return."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """One tensor of one case.

    Attributes:
        tensor: its name.
        node: the node that computes it.
        operands: the node's inputs: the port's own if it returned them.
        got: the port's numbers.
        right: the right numbers, with the largest allowed errors.
        ratio: largest error / bound.
        rms: the root mean square of the errors over that of the bounds.
        is_own: whether the port returned all inputs of the node: the error is then only the node's.
    """

    tensor: str
    node: Node
    operands: tuple[AnyArray | None, ...]
    got: AnyArray
    right: Result
    ratio: float
    rms: float
    is_own: bool

    @property
    def at(self) -> tuple[int, ...]:
        """Index of the worst number."""
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.abs(self.got - self.right.x)
            ratios = np.where(off == 0, 0, off / self.right.errors)
        return tuple(int(i) for i in np.unravel_index(np.argmax(np.nan_to_num(ratios, nan=np.inf)), ratios.shape))


class ShapeError(ValueError):
    """The port's tensor has another shape than the model's."""


class SizeError(ShapeError):
    """The model cannot take inputs of these sizes."""


def judge(model: Model, inputs: Arrays, got: Arrays, rounding: Rounding, runs: int = RUNS) -> list[Judgement]:
    """Judge every tensor of ``got``, in the order of the model.

    A tensor whose node reads only returned tensors is judged by the rounding of that node. The bound of any other is ``spread`` times
    the root mean square of its change if each node between is changed at random by as much as rounding: an estimate, which grows with
    depth as rounding does, and no proof.

    Raises:
        SizeError: a node cannot take its inputs.
        ShapeError: a tensor has another shape than the model's.
    """
    values: dict[str, AnyArray] = {**model.constants, **{name: widen(array) for name, array in inputs.items()}}
    moved: list[dict[str, AnyArray]] = [{} for _ in range(runs)]
    random = np.random.default_rng(0)
    judgements: list[Judgement] = []
    for node in model.nodes:
        operands = operands_of(node, values)
        results = None if operands is None else compute(node, operands, rounding)
        if operands is None or results is None:
            continue
        derived = any(name in run for run in moved[:1] for name in node.inputs)
        if derived or any(name not in got for name in node.outputs):
            for run in moved:
                off = [run.get(name, each) for name, each in zip(node.inputs, operands, strict=True)]
                changed = (compute(node, off, rounding) if derived else results) or ()
                run |= {name: _change(each, random) for name, each in zip(node.outputs, changed, strict=False)}
        for name, right in zip(node.outputs, results, strict=False):
            values[name] = right.x
            # Integers are sizes and places, constants are the model's: a wrong one changes the results.
            computes = right.x.dtype.kind == "f" and right.x.size and node.op != "Constant"
            if name in got and (computes or name in model.outputs):
                allowed = right if not derived else Result(right.x, right.e + _spread([run[name] - right.x for run in moved]))
                judgements.append(compare(name, node, operands, got[name], allowed, is_own=not derived))
                if np.isfinite(got[name]).all():
                    values[name] = judgements[-1].got
                    for run in moved:
                        run.pop(name, None)
    return judgements


def _change(result: Result, random: np.random.Generator) -> AnyArray:
    """A result as a port may have it."""
    if result.x.dtype.kind != "f":
        return result.x
    return result.x + result.errors / np.sqrt(result.terms) * random.uniform(-1, 1, result.x.shape)


def operands_of(node: Node, values: Mapping[str, AnyArray]) -> list[AnyArray | None] | None:
    """A node's inputs; None where one cannot be computed."""
    if any(name and name not in values for name in node.inputs):
        return None
    return [values[name] if name else None for name in node.inputs]


def compute(node: Node, operands: Sequence[AnyArray | None], rounding: Rounding) -> tuple[Result, ...] | None:
    """The results of a node; None where its attributes are not known."""
    try:
        with np.errstate(all="ignore"):
            results = OPERATORS[node.op](rounding, node, *operands)
    except UnsupportedError:
        return None
    except (ValueError, IndexError, TypeError) as error:
        raise SizeError(f"{node.op} of {node.outputs[0]}: {error}") from error
    return results if isinstance(results, tuple) else (results,)


def _spread(moved: Sequence[AnyArray]) -> float:
    far = np.abs(moved)
    typical = max(float(np.sqrt(np.mean(far * far))), float(far.max(initial=0)) / TAIL) if far.size else 0.0
    return BOUNDS["spread"].roundings * typical


def compare(
    name: str, node: Node, operands: Sequence[AnyArray | None], got: AnyArray, right: Result, *, is_own: bool = True
) -> Judgement:
    """Judge one tensor; ShapeError where its shape is another."""
    if got.shape != right.x.shape:
        raise ShapeError(f"{name}: expected shape {right.x.shape}, got {got.shape}")
    wide, allowed = widen(got), right.errors
    error = np.abs(wide.astype(np.float64) - right.x)
    typical, limit = (float(np.sqrt(np.mean(a * a))) if a.size else 0.0 for a in (error, allowed))
    share = 0.0 if typical == 0 else typical / limit if limit and np.isfinite(typical) else np.inf
    return Judgement(name, node, tuple(operands), wide, right, worst(error, allowed), share, is_own)


def find_unsupported(model: Model, inputs: Arrays, rounding: Rounding) -> list[str]:
    """A line for each node whose attributes are not known."""
    values: dict[str, AnyArray] = {**model.constants, **{name: widen(array) for name, array in inputs.items()}}
    lines: list[str] = []
    for node in model.nodes:
        operands = operands_of(node, values)
        if operands is None:
            continue
        try:
            OPERATORS[node.op](rounding, node, *operands)
        except UnsupportedError as error:
            lines.append(f"{node.outputs[0]} ({node.op}): {error}")
        except (ValueError, IndexError, TypeError):
            return lines  # these sizes do not suit the model
        for name, each in zip(node.outputs, compute(node, operands, rounding) or (), strict=False):
            values[name] = each.x
    return lines


def widen(array: AnyArray) -> AnyArray:
    """Floats as float64; other kinds as they are."""
    return array if array.dtype.kind in "biu" else array.astype(np.float64)


# The likely cause of a departure

SUMS = ("Conv", "ConvTranspose", "Gemm", "MatMul")
EXPONENTIALS = ("Sigmoid", "Tanh", "Softmax", "Exp")
COARSE = {"half or TF32": 2.0**-11, "bfloat16": 2.0**-8}
"""Precision -> unit roundoff. Half and TF32 have the same digits."""
FAST = 2.0**-10
"""Relative error of the fast exponentials of GPUs and of tables."""


Fits = Callable[[Sequence[AnyArray | None], float, Rounding], bool]


def round_to(x: AnyArray, unit: float) -> AnyArray:
    """``x`` rounded to as many binary digits as the unit roundoff says, ties to even."""
    mantissa, exponent = np.frexp(x)
    return np.ldexp(np.round(mantissa / unit / 2) * unit * 2, exponent) if unit else x


def explain_precision(judgement: Judgement, rounding: Rounding) -> str:
    """The precision that explains a wrong tensor: its numbers are right for a port that computes so; "" if none does.

    Only if the port returned all inputs of the node.
    """
    node, operands = judgement.node, judgement.operands

    def fits(some: Sequence[AnyArray | None], wider: float, how: Rounding) -> bool:
        results = compute(node, some, how)
        assert results is not None
        right = results[node.outputs.index(judgement.tensor)]
        return (
            compare(judgement.tensor, node, operands, judgement.got, Result(right.x, right.e + wider * np.abs(right.x))).ratio
            <= 1
        )

    if not judgement.is_own:
        return ""
    return next((words for words, fits in _explanations(judgement, fits, rounding) if fits), "")


def _explanations(judgement: Judgement, fits: Fits, rounding: Rounding) -> Iterator[tuple[str, bool]]:
    """Precisions, the finest and most certain first, and whether each explains the tensor."""
    node, operands = judgement.node, judgement.operands
    sums = node.op in SUMS
    for name, unit in COARSE.items():
        rounded = [*(v if v is None or v.dtype.kind != "f" else round_to(v, unit) for v in operands[:2]), *operands[2:]]
        yield f"{name}: operands rounded, sums in float32", sums and fits(rounded, 0.0, rounding)
        yield f"{name}: operands and result rounded, sums in float32", sums and fits(rounded, 2 * unit, rounding)
        yield f"{name}: the result rounded", fits(operands, 2 * unit, rounding)
    yield "a fast exponential", node.op in EXPONENTIALS and fits(operands, FAST, rounding)
    for name, dtype in (("half or TF32", "float16"), ("bfloat16", "bfloat16")):
        results = compute(node, operands, Rounding(replace(rounding.arithmetic, dtype=dtype)))
        if sums and results is not None:
            # Three roundings of each product: of both operands, also of factors folded into the weights, and of the result.
            wide = Result(results[0].x, results[0].errors * 3 / results[0].terms)
            yield (
                f"{name}: errors of the size of its roundings",
                compare(judgement.tensor, node, operands, judgement.got, wide).ratio <= 1,
            )
    yield "sums in half", sums and fits(operands, 0.0, Rounding(replace(rounding.arithmetic, dtype="float16")))


FUSED = (1, 2, 4, 8)
"""Numbers of nodes before a tensor that an engine may have computed together with it."""


def is_fused(model: Model, inputs: Arrays, got: Arrays, judgement: Judgement, rounding: Rounding) -> bool:
    """Whether a tensor is right if a few tensors before it are the model's, not the returned ones.

    An engine that computes several nodes at once may return a tensor between them that it did not use.
    """
    at = next(i for i, node in enumerate(model.nodes) if judgement.tensor in node.outputs)
    part = replace(model, nodes=model.nodes[: at + 1])
    makers = {name: node for node in part.nodes for name in node.outputs}
    within, edge, depth = set[str](), {*judgement.node.inputs}, 0
    while edge and depth < FUSED[-1]:
        within |= edge
        edge = {name for each in edge if each in makers for name in makers[each].inputs} - within
        depth += 1
        if depth in FUSED:
            rest = {name: array for name, array in got.items() if name not in within}
            again = [row for row in judge(part, inputs, rest, rounding) if row.tensor == judgement.tensor]
            if again and again[0].ratio <= 1:
                return True
    return False


def describe_terms(judgement: Judgement, most: int = 3) -> str:
    """The worst number with the terms that it was made of."""
    at, node = judgement.at, judgement.node
    x, w = (*judgement.operands, None, None)[:2]
    line = f"at {at}: got {judgement.got[at]:.9g}, expected {judgement.right.x[at]:.9g}, allowed {judgement.right.errors[at]:.3g}"
    if x is None or w is None or node.op not in SUMS:
        here = [f"{v[at]:.6g}" for v in judgement.operands if v is not None and v.shape == judgement.right.x.shape]
        return f"{line}; of {', '.join(here)}" if here else line
    terms = _terms(node, x, w, at)
    if terms is None:
        return line
    largest = sorted(terms, key=abs, reverse=True)[:most]
    return f"{line}; {len(terms)} products, sum of magnitudes {np.abs(terms).sum():.3g}, largest {', '.join(f'{t:.3g}' for t in largest)}"


def _terms(node: Node, x: AnyArray, w: AnyArray, at: tuple[int, ...]) -> AnyArray | None:
    """The products whose sum is one number; None if they are not separated."""
    if node.op == "Gemm":
        a, b = (v.T if node.get(f"trans{k}", 0) else v for v, k in ((x, "A"), (w, "B")))
        return a[at[0]] * b[:, at[1]]
    if node.op == "MatMul":
        a, b = np.broadcast_to(x, (*np.broadcast_shapes(x.shape[:-2], w.shape[:-2]), *x.shape[-2:])), w
        return a[at[:-1]] * b[..., at[-1]][at[: b.ndim - 2]] if a.ndim == b.ndim else None
    if node.op == "Conv":
        groups = node.get("group", 1)
        each, first = w.shape[1], at[1] // (w.shape[0] // groups) * w.shape[1]
        window = window_of(node, x.shape[2:], w.shape[2:])
        padded = window.pad(x[at[0] : at[0] + 1, first : first + each])
        products = [there[(0, slice(None), *at[2:])] * w[(at[1], slice(None), *tap)] for tap, there in window.taps(padded)]
        return np.concatenate(products)
    return None
