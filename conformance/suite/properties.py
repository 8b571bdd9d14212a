# SPDX-License-Identifier: MIT
"""How a property of the suite is written: a function of the judge and of one case."""

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

from conformance.confirm import confirm
from conformance.diagnosis import diagnose
from conformance.findings import DepartureError, Failure, Record
from conformance.first_layer import first_departure
from conformance.judge import Body, Judge
from conformance.rehearsal import prepare, rehearse
from conformance.terms import terms_at_worst


def cases(strategy: st.SearchStrategy[Any], *, dear: bool = False) -> Callable[[Body], Callable[[Judge], None]]:
    """Make a test of a property: it is run on many cases of ``strategy``, as many as the judge's tier says.

    Args:
        strategy: of the cases.
        dear: whether one runs the network, so that there can be fewer.
    """

    def decorate(body: Body) -> Callable[[Judge], None]:
        @wraps(body)
        def test(judge: Judge) -> None:
            drawn = rehearse(judge, strategy, body, dear=dear)
            with _confirmed(judge, body):
                judge.for_all(strategy, body, dear=dear, drawn=drawn)

        return _as_test(test, body)

    return decorate


def made_cases(
    made: Sequence[Callable[[np.random.Generator], Any]], *, large: bool = False
) -> Callable[[Body], Callable[[Judge], None]]:
    """Make a test of a property on a few cases that are made and not drawn.

    Args:
        made: each makes one case from a seeded generator.
        large: whether they are large frames, the dearest last: the judge's tier says how many of them are tried.
    """

    def decorate(body: Body) -> Callable[[Judge], None]:
        @wraps(body)
        def test(judge: Judge) -> None:
            some = [make(np.random.default_rng(judge.seed)) for make in made[: judge.tier.large if large else None]]
            prepare(judge, some, body)
            with _confirmed(judge, body):
                for case in some:
                    judge.check(body, case)

        return _as_test(test, body)

    return decorate


@contextmanager
def _confirmed(judge: Judge, body: Body) -> Generator[None]:
    """A failure is run again before it is told."""
    try:
        yield
    except (DepartureError, Flaky) as error:
        if judge.shrink:
            first = judge.record.first
            judge.record.failure = _diagnosed(judge, confirm(judge, body), first)
        assert judge.record.failure is not None
        raise DepartureError(judge.record.failure.finding) from error


def _diagnosed(judge: Judge, failure: Failure, first: Failure | None) -> Failure:
    """With words on what it looks like: the case that failed first, for many mistakes look like the smallest one.

    Asking the port again is no part of the test's record.
    """
    met, judge.record = judge.record, Record()
    words = [] if failure.before else [first_departure(judge, failure.finding), diagnose(judge, (first or failure).finding)]
    judge.record = met
    message = "; ".join([failure.finding.message, *filter(None, words)])
    return replace(failure, finding=replace(failure.finding, message=message, terms=terms_at_worst(failure.finding)))


def _as_test(test: Any, body: Body) -> Callable[[Judge], None]:
    # pytest looks for fixtures in the signature: the case is none.
    del test.__wrapped__
    test.property = body
    return test


def find_property(test: str) -> Body:
    """The property of a test by its id, ``stage.test``.

    Raises:
        LookupError: there is none.
    """
    stage, _, name = test.partition(".")
    try:
        return getattr(import_module(f"conformance.suite.test_{stage}"), f"test_{name}").property
    except (ImportError, AttributeError) as error:
        raise LookupError(f"no such test: {test}") from error
