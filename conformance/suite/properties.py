# SPDX-License-Identifier: MIT
"""Make tests of properties; a property is a function of the judge and of one case."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from importlib import import_module
from typing import Any

from hypothesis import strategies as st
from hypothesis.errors import Flaky

from conformance.cases.large_inputs import large_inputs, user_inputs
from conformance.explain.confirm import UNSTABLE, confirm
from conformance.explain.diagnosis import diagnose
from conformance.explain.first_layer import first_departure
from conformance.explain.terms import terms_at_worst
from conformance.judging.findings import DepartureError, Failure, Record
from conformance.judging.judge import Body, Judge
from conformance.judging.search import Drawn, Made, Maker, Makers


def cases(strategy: st.SearchStrategy[Any], *, slow: bool = False) -> Callable[[Body], Callable[[Judge], None]]:
    """Make a test of a property on drawn cases: see `Drawn`."""
    return _tested_on(Drawn(strategy, slow=slow))


def made_cases(
    made: Makers | Callable[[Judge], Makers], *, about: Callable[[Maker], str] = lambda _: ""
) -> Callable[[Body], Callable[[Judge], None]]:
    """Make a test of a property on a few cases that are made: see `Made`."""
    return _tested_on(Made(made, about))


def large_cases(stage: str) -> Callable[[Body], Callable[[Judge], None]]:
    """Make a test of a property on large frames: as many as the judge's tier says, and one of the size that the judge is asked for."""
    return made_cases(lambda judge: large_inputs(stage, judge.tier.large, judge.size, judge.largest_side))


def _tested_on(source: Drawn | Made) -> Callable[[Body], Callable[[Judge], None]]:
    def decorate(body: Body) -> Callable[[Judge], None]:
        @wraps(body)
        def test(judge: Judge) -> None:
            __tracebackhide__ = True
            with _confirmed(judge, body):
                source.check(judge, body)

        # pytest looks for fixtures in the signature, and the case is no fixture.
        made: Any = test
        del made.__wrapped__
        made.property, made.source = body, source
        return made

    return decorate


def user_cases(stage: str) -> Callable[[Body], Callable[[Judge], None]]:
    """Make a test of a property on a frame of a user's size."""
    return made_cases(lambda judge: user_inputs(stage, judge.tier.large, judge.largest_side))


@contextmanager
def _confirmed(judge: Judge, body: Body) -> Generator[None]:
    """Run a failure again before reporting it."""
    __tracebackhide__ = True
    try:
        yield
    except (DepartureError, Flaky) as error:
        if judge.shrink:
            first = judge.record.first
            judge.record.failure = _diagnosed(judge, confirm(judge, body), first)
        assert judge.record.failure is not None
        raise DepartureError(judge.record.failure.finding) from error


def _diagnosed(judge: Judge, failure: Failure, first: Failure | None) -> Failure:
    """Add to the message what the failure looks like, by the case that failed first, the smallest, and those that were answered last.

    The test's record does not count the cases that the port computes for this.
    """
    met, judge.record = judge.record, Record()
    words: list[str] = []
    # What does not come back alone cannot be asked for again.
    if not failure.before and UNSTABLE not in failure.finding.message:
        words = [first_departure(judge, failure.finding), diagnose(judge, [(first or failure).finding, failure.finding])]
    judge.record = met
    message = "; ".join(filter(None, [failure.finding.message, met.about, *words]))
    return replace(failure, finding=replace(failure.finding, message=message, terms=terms_at_worst(failure.finding)))


def find_test(test: str) -> Any:
    """A test by its id, ``stage.test``: a function of the judge.

    Raises:
        LookupError: there is no such test.
    """
    stage, _, name = test.partition(".")
    try:
        return getattr(import_module(f"conformance.suite.test_{stage}"), f"test_{name}")
    except (ImportError, AttributeError) as error:
        raise LookupError(f"no such test: {test}") from error


def find_property(test: str) -> Body:
    """The property of a test by its id, ``stage.test``.

    Raises:
        LookupError: there is none.
    """
    try:
        return find_test(test).property
    except AttributeError as error:
        raise LookupError(f"no such test: {test}") from error
