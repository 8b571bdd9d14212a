# SPDX-License-Identifier: MIT
"""Judge a port of a network on drawn cases, and make the first case that is wrong smaller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import hypothesis
import hypothesis.errors
import numpy as np
from hypothesis import HealthCheck, Phase, settings

from conformance.graph.cases import GraphCase, cases, read_case
from conformance.graph.judgement import (
    Judgement,
    ShapeError,
    SizeError,
    describe_terms,
    explain_precision,
    find_unsupported,
    is_fused,
    judge,
)
from conformance.graph.model import Model
from conformance.graph.ports import GraphPort
from conformance.graph.rounding import AnyArray, Rounding
from conformance.protocol.port import PortError
from stss_ground.errors import InputError

TIERS = {"quick": 8, "full": 40}
"""Tier -> most cases."""
EVERY_CHECK: list[HealthCheck] = [*HealthCheck]  # pyright: ignore[reportAssignmentType]


@dataclass
class Tensor:
    """A tensor over all cases.

    Attributes:
        op: the operator that makes it.
        ratio, rms: largest error / bound, and root mean square of errors over that of bounds.
        is_own: whether its error is its node's alone.
        cases: in which it was judged.
        fused: cases in which it is right only together with nodes before it (`is_fused`).
    """

    op: str
    ratio: float = 0.0
    rms: float = 0.0
    is_own: bool = True
    cases: int = 0
    fused: int = 0

    def take(self, judged: Judgement, *, fused: bool = False) -> None:
        """Take one case; ``fused``: its numbers are right if nodes before it were computed together with it."""
        if not fused:
            self.ratio, self.rms = max(self.ratio, judged.ratio), max(self.rms, judged.rms)
        self.is_own, self.cases, self.fused = self.is_own and judged.is_own, self.cases + 1, self.fused + fused


@dataclass
class Outcome:
    """What was found.

    Attributes:
        tensors: by name, in the model's order: each from the port's own tensors before it.
        ends: the model's outputs, from its inputs: what a user of the port gets.
        wrong: lines on the smallest case that is wrong; empty: none is.
        unknown: a line for each node that was not judged.
        cases: that were judged.
        unsuited: drawn sizes that the model itself cannot take.
    """

    tensors: dict[str, Tensor] = field(default_factory=dict[str, Tensor])
    ends: dict[str, Tensor] = field(default_factory=dict[str, Tensor])
    wrong: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    cases: int = 0
    unsuited: int = 0

    @property
    def passes(self) -> bool:
        """Whether something was judged and nothing departs."""
        return self.cases > 0 and not self.wrong


class WrongError(Exception):
    """A case is wrong; ``lines`` say how."""

    def __init__(self, lines: Sequence[str]):
        super().__init__(lines[0])
        self.lines = tuple(lines)


def judge_port(
    model: Model, port: GraphPort, rounding: Rounding, *, tier: str = "quick", seed: int = 0,
    fixed: Mapping[str, int] | None = None, files: Sequence[str] = (),
) -> Outcome:  # fmt: skip
    """Judge a port.

    Args:
        model: the network.
        port: to be judged.
        rounding: of its arithmetic.
        tier: ``quick`` or ``full``: how many cases.
        seed: of the cases.
        fixed: sizes of open axes; the others are drawn.
        files: ``NAME=FILE.npy`` for each input: one case, in place of drawn ones.

    Raises:
        InputError: files do not fit, or the model takes none of the sizes that were drawn.
    """
    outcome = Outcome(unknown=model.unknown)
    if files:
        try:
            _check(model, port, rounding, read_case(model, files), "the files", outcome)
        except WrongError as error:
            outcome.wrong = error.lines
        except SizeError as error:
            raise InputError(f"--input: {error}") from error
        return outcome
    suits: dict[tuple[tuple[str, int], ...], bool] = {}

    @hypothesis.seed(seed)
    @settings(
        max_examples=TIERS[tier], phases=[Phase.generate, Phase.shrink], database=None, deadline=None,
        report_multiple_bugs=False, suppress_health_check=EVERY_CHECK, print_blob=False,
    )  # fmt: skip
    @hypothesis.given(cases(model, fixed or {}))
    def each(case: GraphCase) -> None:
        key, inputs = tuple(case.sizes.items()), case.inputs(model)
        if key not in suits:
            suits[key] = not case.sizes or _suits(model, inputs, rounding)
        if suits[key]:
            try:
                _check(model, port, rounding, inputs, str(case), outcome)
            except WrongError as error:
                outcome.wrong = error.lines
                raise
        else:
            outcome.unsuited += 1
            hypothesis.reject()

    try:
        each()
    except WrongError:
        pass
    except hypothesis.errors.Flaky:
        outcome.wrong = (*outcome.wrong, "the same case alone is right: the port keeps something from call to call")
    except SizeError as error:
        raise InputError(f"{model.path}: {error}") from error
    except hypothesis.errors.Unsatisfiable:
        pass
    if not outcome.cases:
        raise InputError(f"{model.path}: takes none of the drawn sizes; name them: --shape {_open_axis(model)}=N")
    return outcome


def _open_axis(model: Model) -> str:
    return next((n for each in model.inputs for n in each.shape if isinstance(n, str)), "NAME")


def _suits(model: Model, inputs: Mapping[str, AnyArray], rounding: Rounding) -> bool:
    try:
        judge(model, inputs, {}, rounding, runs=0)
    except SizeError:
        return False
    return True


def _check(model: Model, port: GraphPort, rounding: Rounding, inputs: dict[str, AnyArray], case: str, outcome: Outcome) -> None:
    """Judge one case; WrongError if it is wrong."""
    first = outcome.cases == 0
    outcome.cases += 1
    if first:
        outcome.unknown = (*outcome.unknown, *find_unsupported(model, inputs, rounding))
    where = f"case: {case}"
    try:
        got = whole = port.run({name: array.copy() for name, array in inputs.items()})
        if missing := [name for name in model.outputs if name not in whole]:
            raise PortError(f"output {missing[0]} is missing")
        if layers := getattr(port, "layers", None):
            got = layers({name: array.copy() for name, array in inputs.items()})
    except Exception as error:
        # A port is a stranger.
        raise WrongError([f"{type(error).__name__}: {_line(error)}", where]) from error
    try:
        rows = judge(model, inputs, {name: got[name] for name in model.tensors if name in got}, rounding)
        ends = judge(model, inputs, {name: whole[name] for name in model.outputs}, rounding)
    except SizeError:
        raise
    except ShapeError as error:
        raise WrongError([str(error), where]) from error
    departs = next((row for row in rows if not row.ratio <= 1 and not is_fused(model, inputs, got, row, rounding)), None)
    departs = departs or next((row for row in ends if not row.ratio <= 1), None)
    for number, row in enumerate(rows):
        # Tensors behind the first departure are not looked at for fusion.
        fused = row.ratio > 1 and (departs not in rows or number < rows.index(departs))
        outcome.tensors.setdefault(row.tensor, Tensor(row.node.op)).take(row, fused=fused)
    for row in ends:
        outcome.ends.setdefault(row.tensor, Tensor(row.node.op)).take(row)
    if departs:
        raise WrongError([*_lines(departs, rows, ends, rounding), where])


def _lines(wrong: Judgement, rows: Sequence[Judgement], ends: Sequence[Judgement], rounding: Rounding) -> list[str]:
    """The first tensor that departs, what it looks like, its worst number, and what becomes of it."""
    before = sum(row.ratio <= 1 for row in rows[: rows.index(wrong)]) if wrong in rows else 0
    kind = "introduced here" if wrong.is_own else "made here or in nodes before it whose tensors were not handed over"
    lines = [
        f"first departs at {wrong.tensor} ({wrong.node.op}), behind {before} right tensors: error / bound {wrong.ratio:.3g}, "
        f"rms / bound {wrong.rms:.3g}, {kind}"
    ]
    if said := explain_precision(wrong, rounding):
        lines.append(f"looks like {said}")
    lines.append(describe_terms(wrong))
    lines += [
        f"output {end.tensor}: propagated, error {np.abs(end.got - end.right.x).max(initial=0):.3g}, error / bound {end.ratio:.3g}"
        for end in ends
    ]
    return lines


def _line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:300] if lines else ""
