# SPDX-License-Identifier: MIT
"""The explanation of a failure, beyond its numbers; the failure stays whole, whatever fails meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from conformance.explain.confirm import UNSTABLE, confirm
from conformance.explain.diagnosis import diagnose
from conformance.explain.first_layer import first_departure
from conformance.explain.terms import terms_at_worst
from conformance.judging.findings import Failure, Record
from conformance.judging.judge import Body, Judge

T = TypeVar("T")


def explain(judge: Judge, body: Body) -> Failure:
    """Confirm the failure of the test that ran last; add whether it comes back, where it begins, and what it looks like.

    The test's record does not count the cases that the port computes for this.

    Args:
        judge: its ``record`` has the failure.
        body: the property.
    """
    failed: list[str] = []

    def tried(part: Callable[[], T], instead: T) -> T:
        # Ports raise anything, and so do mistakes on unforeseen cases: a failure is told with or without its explanation.
        try:
            return part()
        except Exception as error:
            failed.append(f"explaining it failed: {type(error).__name__}: {error}")
            return instead

    met, smallest = judge.record, judge.failure()
    first = met.first or smallest
    judge.record = Record()
    failure = tried(lambda: confirm(judge, body, smallest, first), smallest)
    words = [met.about]
    # An answer that does not come back alone cannot be asked for again.
    if not failure.before and UNSTABLE not in failure.finding.message:
        words += [
            tried(lambda: first_departure(judge, failure.finding), ""),
            tried(lambda: diagnose(judge, [first.finding, failure.finding, *met.wrong]), ""),
        ]
    judge.record = met
    terms = tried(lambda: terms_at_worst(failure.finding), ())
    message = "; ".join(filter(None, [failure.finding.message, *words, *failed]))
    return replace(failure, finding=replace(failure.finding, message=message, terms=terms))
