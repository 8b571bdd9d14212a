# SPDX-License-Identifier: MIT
"""The explanation of a failure, beyond its numbers; an error of the explanation does not change the failure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from conformance.explain.choices import decisive_choices
from conformance.explain.confirm import UNSTABLE, confirm
from conformance.explain.diagnosis import diagnose
from conformance.explain.first_layer import first_departure
from conformance.explain.terms import terms_at_worst
from conformance.judging.findings import Failure, Record
from conformance.judging.judge import Body, Judge

T = TypeVar("T")


def explain(judge: Judge, body: Body) -> Failure:
    """Confirm the failure of the test that ran last; add whether it repeats, where it begins, and a known mistake like it.

    The test's record does not count the cases that the port computes for this.

    Args:
        judge: its ``record`` has the failure.
        body: the property.
    """
    faults: list[str] = []

    def attempt(part: Callable[[], T], instead: T) -> T:
        # Ports, and mistakes on unforeseen cases, raise any error: a failure is reported with or without its explanation.
        try:
            return part()
        except Exception as error:
            faults.append(f"explaining it failed: {type(error).__name__}: {error}")
            return instead

    record, smallest = judge.record, judge.failure()
    # To run it again would take as long, and slowness is no matter of chance.
    if judge.is_silent(smallest.finding.case.stage) or smallest.finding.late:
        return smallest
    first = record.first or smallest
    judge.record = Record()
    failure = attempt(lambda: confirm(judge, body, smallest, first), smallest)
    words, findings = [record.about], [first.finding, failure.finding, *record.wrong]
    # An answer that a case alone does not repeat cannot be computed again.
    if not failure.before and UNSTABLE not in failure.finding.message:
        words += [
            attempt(lambda: first_departure(judge, failure.finding), ""),
            attempt(lambda: decisive_choices(judge, findings), ""),
            attempt(lambda: diagnose(judge, findings), ""),
        ]
    judge.record = record
    terms = attempt(lambda: terms_at_worst(failure.finding), ())
    message = "; ".join(text for text in (failure.finding.message, *words, *faults) if text)
    return replace(failure, finding=replace(failure.finding, message=message, terms=terms))
