# SPDX-License-Identifier: MIT
"""Judge a port of a network on drawn cases, and make the first case that is wrong smaller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import monotonic
from typing import Any

import hypothesis
import hypothesis.errors
import numpy as np
from hypothesis import Phase

from conformance.answers.expected import Expected
from conformance.graph.cases import GraphCase, cases
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
from conformance.graph.ports import STAGE, GraphPort, graph_abilities_of
from conformance.graph.rounding import AnyArray, Rounding
from conformance.judging.findings import DepartureError, Failure, Finding
from conformance.judging.search import SHRINK_SECONDS, EnoughError, draw_cases
from conformance.protocol.port import Case, PortError, error_text, foreign_code
from stss_ground.errors import InputError

TIERS = {"quick": 8, "full": 40}
"""Tier -> most cases."""
FORGETS = "the same case alone is right: the port keeps state from call to call"
MOST_LINES = 12
"""Most lines of a port's error that are shown."""


@dataclass
class Tensor:
    """A tensor over all cases.

    Attributes:
        op: the operator that makes it.
        ratio, rms: largest error / bound, and root mean square of errors over that of bounds.
        is_own: whether its error is only its node's.
        cases: in which it was judged.
        fused: cases in which it is right only together with nodes before it (`is_fused`).
    """

    op: str
    ratio: float = 0.0
    rms: float = 0.0
    is_own: bool = True
    cases: int = 0
    fused: int = 0

    def take(self, judgement: Judgement, *, fused: bool = False) -> None:
        """Take one case; ``fused``: its numbers are right if nodes before it were computed together with it."""
        if not fused:
            self.ratio, self.rms = max(self.ratio, judgement.ratio), max(self.rms, judgement.rms)
        self.is_own, self.cases, self.fused = self.is_own and judgement.is_own, self.cases + 1, self.fused + fused


@dataclass
class Outcome:
    """The result of a run.

    Attributes:
        tensors: by name, in the model's order: each from the port's own tensors before it.
        ends: the model's outputs, from its inputs, as a user of the port gets them.
        failure: the smallest case that is wrong; None: none is.
        unknown: a line for each node that was not judged.
        cases: that were judged.
        unsuited: drawn sizes that the model itself cannot take.
        unjudged: outputs that depend on unjudged nodes.
    """

    tensors: dict[str, Tensor] = field(default_factory=dict[str, Tensor])
    ends: dict[str, Tensor] = field(default_factory=dict[str, Tensor])
    failure: Failure | None = None
    unknown: tuple[str, ...] = ()
    cases: int = 0
    unsuited: int = 0
    unjudged: tuple[str, ...] = ()

    @property
    def passes(self) -> bool:
        """Whether something was judged and nothing departs."""
        return bool(self.tensors or self.ends) and self.failure is None

    @property
    def wrong(self) -> tuple[str, ...]:
        """Lines on the failure, or that nothing was judged; empty: all is right."""
        if self.failure is None:
            return () if self.passes else ("nothing was judged",)
        return (self.failure.finding.message, *self.failure.finding.terms)


def judge_port(
    model: Model, port: GraphPort, rounding: Rounding, *, tier: str = "quick", seed: int = 0,
    fixed: Mapping[str, int] | None = None, own_inputs: Sequence[dict[str, AnyArray]] = (),
) -> Outcome:  # fmt: skip
    """Judge a port.

    Args:
        model: the network.
        port: to be judged.
        rounding: of its arithmetic.
        tier: ``quick`` or ``full``: how many cases.
        seed: of the cases.
        fixed: sizes of open axes; the others are drawn.
        own_inputs: inputs, in place of drawn ones, up to the first that is wrong.

    Raises:
        InputError: the model does not take ``own_inputs``, or none of the sizes that were drawn.
    """
    outcome = Outcome(unknown=model.unknown)
    search = _Search(model, port, rounding, outcome)
    try:
        if own_inputs:
            for number, inputs in enumerate(own_inputs):
                search.check(inputs, "as given", own_inputs[:number])
            return outcome
        _draw(search, TIERS[tier], seed, fixed or {})
    except DepartureError:
        pass
    except SizeError as error:
        raise InputError(f"{'--input' if own_inputs else model.path}: {error}") from error
    if not outcome.cases:
        raise InputError(f"{model.path}: takes none of the drawn sizes; name them: --shape {_open_axis(model)}=N")
    return outcome


def _draw(search: _Search, most: int, seed: int, fixed: Mapping[str, int]) -> None:
    """Check drawn cases, and make one that fails smaller."""
    try:
        draw_cases(cases(search.model, fixed), search.take, most, seed, [Phase.generate, Phase.shrink])
    except EnoughError:
        pass
    except hypothesis.errors.Flaky:
        search.fails_behind_others()
    except hypothesis.errors.Unsatisfiable:
        pass


class _Search:
    """Checks drawn cases, and then smaller ones, until the time for that is over."""

    def __init__(self, model: Model, port: GraphPort, rounding: Rounding, outcome: Outcome):
        self.model, self._port, self._rounding, self._outcome = model, port, rounding, outcome
        self._abilities = graph_abilities_of(port)
        self._suits: dict[tuple[tuple[str, int], ...], bool] = {}
        self._before: list[GraphCase] = []
        self._failed_at = 0.0

    def take(self, case: GraphCase) -> None:
        """Check a drawn case; DepartureError if it is wrong."""
        if self._failed_at:
            if monotonic() - self._failed_at > SHRINK_SECONDS:
                raise EnoughError
            if self._abilities.restart is not None:
                self._abilities.restart()
        key, inputs = tuple(case.sizes.items()), case.inputs(self.model)
        if key not in self._suits:
            self._suits[key] = not case.sizes or _suits(self.model, inputs, self._rounding)
        if not self._suits[key]:
            self._outcome.unsuited += 1
            hypothesis.reject()
        try:
            self.check(inputs, str(case))
        except DepartureError:
            self._failed_at = self._failed_at or monotonic()
            raise
        if not self._failed_at:
            self._before.append(case)

    def fails_behind_others(self) -> None:
        """Note that a case is wrong after others, and right alone."""
        assert self._outcome.failure is not None
        failure = self._outcome.failure
        finding = replace(failure.finding, terms=(*failure.finding.terms, FORGETS))
        before = tuple(case.inputs(self.model) for case in self._before)
        self._outcome.failure = Failure(finding, failure.drawn_case, before)

    def check(self, inputs: dict[str, AnyArray], words: str, before: Sequence[dict[str, AnyArray]] = ()) -> None:
        """Judge a case; DepartureError if it is wrong, with the failure in the outcome."""
        try:
            self._judge(inputs, words)
        except DepartureError as error:
            self._outcome.failure = Failure(error.finding, inputs, tuple(before))
            raise

    def _judge(self, inputs: dict[str, AnyArray], words: str) -> None:
        """Judge one case; DepartureError if it is wrong."""
        model, rounding, outcome = self.model, self._rounding, self._outcome
        first = outcome.cases == 0
        outcome.cases += 1
        if first:
            outcome.unknown = (*outcome.unknown, *find_unsupported(model, inputs, rounding))
        case = Case(STAGE, inputs)
        where = f"case: {words}"
        try:
            with foreign_code():
                got = whole = self._port.run({name: array.copy() for name, array in inputs.items()})
            if missing := [name for name in model.outputs if name not in whole]:
                raise PortError(f"output {missing[0]} is missing")
            if self._abilities.layers is not None:
                with foreign_code():
                    got = self._abilities.layers({name: array.copy() for name, array in inputs.items()})
            _require_numbers(model, whole)
            _require_numbers(model, got)
        except Exception as error:
            # A port is foreign code.
            headline, *more = _lines_of(error)
            raise DepartureError(Finding(headline, case, "", None, None, (*more, where))) from error
        try:
            rows = judge(model, inputs, {name: got[name] for name in model.tensors if name in got}, rounding)
            ends = judge(model, inputs, {name: whole[name] for name in model.outputs}, rounding)
        except SizeError:
            raise
        except ShapeError as error:
            raise DepartureError(Finding(str(error), case, "", None, None, (where,))) from error
        outcome.unjudged = tuple(name for name in model.outputs if name not in {row.tensor for row in ends})
        departs = next((row for row in rows if not row.ratio <= 1 and not is_fused(model, inputs, got, row, rounding)), None)
        departs = departs or next((row for row in ends if not row.ratio <= 1), None)
        for number, row in enumerate(rows):
            # Tensors behind the first departure are not checked for fusion.
            fused = row.ratio > 1 and (departs not in rows or number < rows.index(departs))
            outcome.tensors.setdefault(row.tensor, Tensor(row.node.op)).take(row, fused=fused)
        for row in ends:
            outcome.ends.setdefault(row.tensor, Tensor(row.node.op)).take(row)
        if departs:
            headline, *more = _lines(departs, rows, ends, rounding)
            right = Expected(departs.right.x, departs.right.errors)
            raise DepartureError(Finding(headline, case, departs.tensor, departs.got, right, (*more, where)))


def _open_axis(model: Model) -> str:
    return next((n for each in model.inputs for n in each.shape if isinstance(n, str)), "NAME")


def _suits(model: Model, inputs: Mapping[str, AnyArray], rounding: Rounding) -> bool:
    try:
        judge(model, inputs, {}, rounding, runs=0)
    except SizeError:
        return False
    return True


def _require_numbers(model: Model, tensors: Mapping[str, Any]) -> None:
    """Raise PortError unless the model's tensors among ``tensors`` are arrays of numbers; bfloat16 is a type of a package of its own."""
    for name in (name for name in model.tensors if name in tensors):
        dtype = getattr(tensors[name], "dtype", None)
        if not isinstance(tensors[name], np.ndarray) or (tensors[name].dtype.kind not in "biuf" and str(dtype) != "bfloat16"):
            raise PortError(f"{name}: expected an array of numbers, got {dtype or type(tensors[name]).__name__}")


def _lines(wrong: Judgement, rows: Sequence[Judgement], ends: Sequence[Judgement], rounding: Rounding) -> list[str]:
    """The first tensor that departs, its likely cause, its worst number, and its effect on the outputs."""
    before = sum(row.ratio <= 1 for row in rows[: rows.index(wrong)]) if wrong in rows else 0
    kind = "introduced here" if wrong.is_own else "introduced here, or in nodes before it whose tensors the port did not return"
    lines = [
        f"first departs at {wrong.tensor} ({wrong.node.op}), behind {before} right tensors: error / bound {wrong.ratio:.3g}, "
        f"rms / bound {wrong.rms:.3g}, {kind}"
    ]
    if precision := explain_precision(wrong, rounding):
        lines.append(f"looks like {precision}")
    lines.append(describe_terms(wrong))
    lines += [
        f"output {end.tensor}: propagated, error {np.abs(end.got - end.right.x).max(initial=0):.3g}, error / bound {end.ratio:.3g}"
        for end in ends
    ]
    return lines


def _lines_of(error: Exception) -> list[str]:
    """Lines on a port's error."""
    text = str(error) if isinstance(error, PortError) else error_text(error)
    return [line[:300] for line in text.strip().splitlines()[:MOST_LINES]] or [""]
