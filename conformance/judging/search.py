# SPDX-License-Identifier: MIT
"""Draws the cases of a property, looks for large errors, and makes a case that fails smaller; Hypothesis does the work."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from time import monotonic
from typing import Any

import hypothesis
import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

from conformance.judging.findings import DepartureError, Failure
from conformance.judging.judge import Body, Judge

Maker = Callable[[np.random.Generator], Any]
Makers = Sequence[Maker]
SHRINK_SECONDS = 60.0
"""Most time for making a failing case smaller; seconds."""
TELL_SECONDS = 5.0
"""After this time of making a failure smaller, it is reported before it has its smallest form; seconds."""
MOST_DRAWN = 6
"""Most strategies whose cases are remembered: tests of one strategy are not far from each other."""
_drawn: dict[tuple[int, int, int], tuple[st.SearchStrategy[Any], list[Any]]] = {}
"""By the identity of a strategy, which is kept alive."""


class DrawnCases:
    """Cases of a strategy, as many as the judge's tier says; the same seed gives the same ones.

    Args:
        strategy: draws the cases.
        slow: a case takes time, as the network does: fewer cases are drawn.
    """

    def __init__(self, strategy: st.SearchStrategy[Any], *, slow: bool = False):
        self._strategy, self._slow = strategy, slow

    def cases(self, judge: Judge) -> list[Any]:
        """The cases, without a port: the cases on which a program is judged. They are the same objects for each test of a strategy."""
        key = id(self._strategy), self._count(judge), judge.seed
        if key not in _drawn:
            cases: list[Any] = []
            self._draw(judge, cases.append, [Phase.generate])
            while len(_drawn) >= MOST_DRAWN:
                _drawn.pop(next(iter(_drawn)))
            _drawn[key] = self._strategy, cases
        return list(_drawn[key][1])

    def check(self, judge: Judge, body: Body) -> None:
        """Run ``body`` on the cases, and make a case that fails smaller.

        The cases of a port in this process are steered towards larger errors. Those of a program are drawn first and computed together;
        they are drawn again only if one of them fails.

        Raises:
            DepartureError: the property does not hold; the failure is in the judge's ``record``.
        """
        right = None
        if judge.is_program:
            right = judge.first_wrong(body, self.cases(judge))
            if right is None:
                return
            if not judge.shrink:
                raise DepartureError(judge.failure().finding)
        search = _Search(judge, body, right)
        phases = [Phase.generate, *([] if judge.is_program else [Phase.target]), *([Phase.shrink] if judge.shrink else [])]
        try:
            self._draw(judge, search.run, phases)
        except EnoughError:
            judge.record.failure = search.smallest or judge.failure()
            raise DepartureError(judge.failure().finding) from None

    def _draw(self, judge: Judge, take: Callable[[Any], None], phases: list[Phase]) -> None:
        """Call ``take`` with the cases, up to the first at which it raises."""
        draw_cases(self._strategy, take, self._count(judge), judge.seed, phases)

    def _count(self, judge: Judge) -> int:
        return judge.tier.slow if self._slow else judge.tier.fast


class MadeCases:
    """Cases that functions make, not Hypothesis.

    Args:
        makers: each makes one case from a seeded generator; or a function of the judge that gives them.
        about: words on a made case, for the message of its failure.
    """

    def __init__(self, makers: Makers | Callable[[Judge], Makers], about: Callable[[Maker], str] = lambda _: ""):
        self._makers, self._about = makers, about

    def cases(self, judge: Judge) -> list[Any]:
        """The cases."""
        return [make(np.random.default_rng(judge.seed)) for make in self._makers_for(judge)]

    def check(self, judge: Judge, body: Body) -> None:
        """Run ``body`` on the cases; DepartureError if the property does not hold, with the failure in the judge's ``record``."""
        wrong = judge.first_wrong(body, self.cases(judge))
        if wrong is not None:
            judge.record.about = self._about(self._makers_for(judge)[wrong]) or judge.record.about
            raise DepartureError(judge.failure().finding)

    def _makers_for(self, judge: Judge) -> Makers:
        return self._makers(judge) if callable(self._makers) else self._makers


def draw_cases(
    strategy: st.SearchStrategy[Any], take: Callable[[Any], None], most: int, seed: int, phases: Sequence[Phase]
) -> None:
    """Call ``take`` with ``most`` cases of a strategy, up to the first at which it raises; the same seed gives the same cases."""

    @hypothesis.seed(seed)
    @settings(
        max_examples=most, phases=phases, database=None, deadline=None,
        report_multiple_bugs=False, suppress_health_check=[*HealthCheck], print_blob=False,
    )  # fmt: skip
    @hypothesis.given(strategy)
    def each(case: Any) -> None:
        take(case)

    with _no_local_constants():
        each()


@contextmanager
def _no_local_constants() -> Generator[None]:
    """Draw no constants of the modules that are not installed packages.

    Hypothesis reads them in whatever such modules are imported, so cases would depend on these, and not on the seed alone: a checkout of
    the judge, or one more import, would give others than the wheel.
    """
    providers: Any = sys.modules.get("hypothesis.internal.conjecture.providers")
    names = ("_get_local_constants", "CONSTANTS_CACHE")
    if not all(hasattr(providers, name) for name in names):  # older versions draw no such constants
        yield
        return
    theirs = [getattr(providers, name) for name in names]
    ours = type(providers.GLOBAL_CONSTANTS), type(providers.CONSTANTS_CACHE)(1024)
    try:
        for name, value in zip(names, ours, strict=True):
            setattr(providers, name, value)
        yield
    finally:
        for name, value in zip(names, theirs, strict=True):
            setattr(providers, name, value)


class EnoughError(BaseException):
    """Ends a run of Hypothesis, which takes no notice of it."""


class _Search:
    """Looks for a case that fails, and then for smaller ones, until the time for that is over.

    Args:
        judge: checks the cases.
        body: the property.
        right: number of cases that have been judged already; the next one fails. None: nothing is known.

    Attributes:
        smallest: the failure of the case with the fewest numbers.
    """

    def __init__(self, judge: Judge, body: Body, right: int | None):
        self.smallest: Failure | None = None
        self._judge, self._body, self._right = judge, body, right
        self._count, self._failed_at, self._has_told = 0, 0.0, False

    def run(self, case: Any) -> None:
        """Check a case; DepartureError if it is wrong."""
        self._count += 1
        if self._right is not None and self._count <= self._right:
            return
        self._look_at_the_time()
        if self.smallest is not None and self._judge.is_silent(self.smallest.finding.case.stage):
            raise EnoughError
        try:
            self._judge.check(self._body, case)
        except DepartureError:
            self._failed_at = self._failed_at or monotonic()
            failure = self._judge.failure()
            if self.smallest is None or _numbers(failure.drawn_case) <= _numbers(self.smallest.drawn_case):
                self.smallest = failure
            if not self._judge.shrink:  # by itself Hypothesis goes on steering the cases that are right
                raise EnoughError from None
            raise
        if self._right is None:
            for output, worst in self._judge.near.items():
                hypothesis.target(worst, label=output)
        elif self._count == self._right + 1:  # it failed among others, and passes alone
            raise EnoughError

    def _look_at_the_time(self) -> None:
        if not self._failed_at or self.smallest is None:
            return
        seconds = monotonic() - self._failed_at
        if seconds > SHRINK_SECONDS:
            raise EnoughError
        if seconds > TELL_SECONDS and not self._has_told:
            self._has_told = True
            self._judge.tell(self.smallest.finding)


def _numbers(case: Any) -> int:
    """The count of numbers in a case."""
    if isinstance(case, np.ndarray):
        return case.size
    if isinstance(case, Mapping):
        return sum(map(_numbers, case.values()))
    return sum(map(_numbers, case)) if isinstance(case, (list, tuple)) else 1
