# SPDX-License-Identifier: MIT
"""Make tests of properties; a property is a function of the judge and of one case."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from importlib import import_module
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.errors import Flaky

from conformance.cases.large_inputs import Made, large_inputs
from conformance.explain.confirm import UNSTABLE, confirm
from conformance.explain.diagnosis import diagnose
from conformance.explain.first_layer import first_departure
from conformance.explain.terms import terms_at_worst
from conformance.judging.findings import DepartureError, Failure, Record
from conformance.judging.judge import Body, Judge
from conformance.judging.search import drawn_cases, for_all


def cases(strategy: st.SearchStrategy[Any], *, slow: bool = False) -> Callable[[Body], Callable[[Judge], None]]:
    """Make a test of a property, which runs on as many drawn cases as the judge's tier says.

    Args:
        strategy: draws the cases.
        slow: a case runs the network, which takes time: fewer cases are drawn.
    """

    def decorate(body: Body) -> Callable[[Judge], None]:
        @wraps(body)
        def test(judge: Judge) -> None:
            __tracebackhide__ = True
            with _confirmed(judge, body):
                for_all(judge, strategy, body, slow=slow)

        return _as_test(test, body, lambda judge: drawn_cases(judge, strategy, slow=slow))

    return decorate


def made_cases(
    made: Sequence[Made] | Callable[[Judge], Sequence[Made]],
    *,
    about: Callable[[Made], str] = lambda _: "",
) -> Callable[[Body], Callable[[Judge], None]]:
    """Make a test of a property on a few cases that are made, not drawn.

    Args:
        made: each makes one case from a seeded generator; or what the judge asks for.
        about: words on a made case, for the message of its failure.
    """

    def chosen(judge: Judge) -> Sequence[Made]:
        return made(judge) if callable(made) else made

    def decorate(body: Body) -> Callable[[Judge], None]:
        def some(judge: Judge) -> list[Any]:
            return [make(np.random.default_rng(judge.seed)) for make in chosen(judge)]

        @wraps(body)
        def test(judge: Judge) -> None:
            __tracebackhide__ = True
            with _confirmed(judge, body):
                wrong = judge.first_wrong(body, some(judge))
                if wrong is not None:
                    judge.record.about = about(chosen(judge)[wrong])
                    raise DepartureError(judge.failure().finding)

        return _as_test(test, body, some)

    return decorate


def large_cases(stage: str) -> Callable[[Body], Callable[[Judge], None]]:
    """Make a test of a property on large frames: as many as the judge's tier says, and one of the size that the judge is asked for."""
    return made_cases(lambda judge: large_inputs(stage, judge.tier.large, judge.size, judge.largest_side))


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
    """Add to the message what the failure looks like, judged by the case that failed first: the smallest case fits many mistakes.

    The test's record does not count the cases that the port computes for this.
    """
    met, judge.record = judge.record, Record()
    words: list[str] = []
    # What does not come back alone cannot be asked for again.
    if not failure.before and UNSTABLE not in failure.finding.message:
        words = [first_departure(judge, failure.finding), diagnose(judge, (first or failure).finding)]
    judge.record = met
    message = "; ".join(filter(None, [failure.finding.message, met.about, *words]))
    return replace(failure, finding=replace(failure.finding, message=message, terms=terms_at_worst(failure.finding)))


def _as_test(test: Any, body: Body, some: Callable[[Judge], list[Any]]) -> Callable[[Judge], None]:
    # pytest looks for fixtures in the signature, and the case is no fixture.
    del test.__wrapped__
    test.property, test.some = body, some
    return test


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
