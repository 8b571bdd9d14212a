# SPDX-License-Identifier: MIT
"""The judge's records: a departure, the cases of a test, the result of a test."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected, largest
from conformance.protocol.port import Case

DENORMAL = 2.0**-126
"""A bound up to this one only allows a denormal number to be 0."""
MOST_WRONG = 6
"""Failing cases of one test that are remembered: a mistake is named if it explains all of them."""
LARGE = 48
"""Rows or columns of a frame that no drawn case has."""


class DepartureError(AssertionError):
    """A port's answer is wrong: the message says where and by how much."""

    def __init__(self, finding: Finding):
        super().__init__(finding.message)
        self.finding = finding


class WrongError(AssertionError):
    """Numbers are wrong. The caller knows the case, and raises a `DepartureError` with it."""

    def __init__(self, message: str, output: str, got: NDArray[Any] | None, expected: Expected | None):
        super().__init__(message)
        self.message, self.output, self.got, self.expected = message, output, got, expected

    def of(self, case: Case) -> DepartureError:
        """The departure on this case."""
        return DepartureError(Finding(self.message, case, self.output, self.got, self.expected))


@dataclass(frozen=True)
class Finding:
    """One wrong output: enough to show it and to run it again.

    Attributes:
        message: what departs, where, by how much.
        case: the port's inputs.
        output: name of the wrong output.
        got: the port's answer; None: it gave none.
        expected: the right answer; None: it is not known.
        terms: lines on the worst pixel (``conformance.explain.terms``).
        late: the time of a program's start was over.
    """

    message: str
    case: Case
    output: str
    got: NDArray[Any] | None
    expected: Expected | None
    terms: tuple[str, ...] = ()
    late: bool = False


@dataclass(frozen=True)
class Failure:
    """A property that does not hold.

    Attributes:
        finding: the wrong output.
        drawn_case: the property's own case, from which it can be run again.
        before: the cases that were checked before it, oldest first; once the failure is confirmed, those that it needs.
    """

    finding: Finding
    drawn_case: Any
    before: tuple[Any, ...] = ()


@dataclass
class Record:
    """The cases of one test, and their results.

    Attributes:
        cases: number of cases that the port computed.
        undecided: numbers for which rounding decides between several right answers.
        unjudged: answers that were not judged, since rounding decides on the whole of them.
        worst: largest error / bound of each output, by ``stage.output``.
        failure: the failure of the test, in its smallest form.
        first: the first failure of the test.
        largest: the largest height and width among the cases.
        about: words on the case that is checked now, for the message of its failure.
        wrong: findings of the last cases that failed.
    """

    cases: int = 0
    undecided: int = 0
    unjudged: int = 0
    worst: dict[str, float] = field(default_factory=dict[str, float])
    failure: Failure | None = None
    first: Failure | None = None
    largest: tuple[int, int] = (0, 0)
    about: str = ""
    wrong: deque[Finding] = field(default_factory=lambda: deque[Finding](maxlen=MOST_WRONG))

    def count(self, sizes: Mapping[str, int]) -> None:
        """Count one more case, of these sizes."""
        self.cases += 1
        self.largest = max(self.largest[0], sizes["H"]), max(self.largest[1], sizes["W"])


@dataclass
class TestResult:
    """How one test ended.

    Attributes:
        id: ``stage.test``, as a file of known failures names it.
        stage: its stage.
        property: the property that it tests, in words.
        outcome: ``passed``, ``failed``, ``skipped`` (the port lacks the stage), ``known`` (failed, as expected) or ``error``.
        message: the reason, unless it passed.
        seconds: duration.
        record: its cases and results.
    """

    __test__ = False  # for pytest: not a test class

    id: str
    stage: str
    property: str
    outcome: str
    message: str = ""
    seconds: float = 0.0
    record: Record = field(default_factory=Record)


def tally(records: Sequence[Record]) -> Counter[str]:
    """Total cases, undecided numbers and unjudged cases of several tests."""
    return Counter({
        "cases": sum(r.cases for r in records),
        "undecided": sum(r.undecided for r in records),
        "unjudged": sum(r.unjudged for r in records),
    })  # fmt: skip


def describe(output: str, got: NDArray[Any], expected: Expected) -> str:
    """One line on the worst number of ``got``, and the share of it that departs.

    Args:
        output: ``stage.name``.
        got: the port's answer.
        expected: the right answer.
    """
    if got.shape != expected.want.shape:
        return f"{output}: expected shape {expected.want.shape}, got {got.shape}"
    closer = expected.closer(got)
    ratios, worst = closer.ratios(got), largest(closer, got)
    place = tuple(int(i) for i in np.unravel_index(int(ratios.argmax()), ratios.shape))
    allowed = float(np.broadcast_to(np.asarray(closer.allowed), got.shape)[place])
    at = place[:-1] if expected.vectors else place
    answer, want = (", ".join(f"{number:.9g}" for number in np.atleast_1d(a[at])) for a in (got, expected.want))
    share = float((ratios > 1).mean())
    if closer is not expected:
        return (
            f"{output}: rms / bound {expected.together(got):.3g}, though error / bound is at most {largest(expected, got):.3g}; "
            f"largest error at {list(place)}: got {answer}, expected {want}; {share:.1%} of {got.size} errors are above {allowed:.3g}, "
            "the bound of the rms"
        )
    by = "wrong" if allowed <= DENORMAL else f"error / bound {worst:.3g}"
    return (
        f"{output}: {by} at {list(place)}: got {answer}, expected {want}"
        f"{f', allowed {allowed:.3g}' if allowed > DENORMAL else ''}; {share:.1%} of {got.size} numbers depart{_from(ratios > 1)}"
    )


def _from(wrong: NDArray[np.bool_]) -> str:
    """For a large frame, the row and the column at which the wrong numbers begin: the limit of an index or of a tile."""
    words: list[str] = []
    for axis, name in enumerate(("row", "column")) if wrong.ndim in (2, 3) else ():
        first = int(wrong.any(axis=tuple(i for i in range(wrong.ndim) if i != axis)).argmax())
        if wrong.shape[axis] > LARGE and first:
            words.append(f"{name} {first}")
    return f", none before {' or '.join(words)}" if words else ""
