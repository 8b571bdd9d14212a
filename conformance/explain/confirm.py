# SPDX-License-Identifier: MIT
"""Run a failure again, alone and after the cases before it, and say if it occurs only sometimes."""

from __future__ import annotations

from dataclasses import replace

from conformance.judging.findings import Failure
from conformance.judging.judge import Body, Judge

UNSTABLE = "differs from run to run"


def confirm(judge: Judge, body: Body) -> Failure:
    """Confirm the failure of the test that ran last; its message says if it does not fail alone.

    Args:
        judge: its ``record`` has the failure.
        body: the property.

    Returns:
        The smallest case if that fails alone. Otherwise the first case that failed, with as few of the cases before it as it needs.
    """
    small, first = judge.record.failure, judge.record.first
    assert small is not None
    assert first is not None
    if (found := fails(judge, body, replace(small, before=()))) is not None:
        return found
    few = 1
    while first.before:
        before = first.before[-few:]
        if (found := fails(judge, body, replace(first, before=before))) is not None:
            return _with_words(
                found, f"depends on the {f'{len(before)} cases' if len(before) > 1 else 'case'} before: it passes alone"
            )
        if len(before) == len(first.before):
            break
        few *= 2
    return _with_words(replace(first, before=()), f"{UNSTABLE}: it passed when it was run again")


def fails(judge: Judge, body: Body, failure: Failure) -> Failure | None:
    """The failure as it is now, after the cases before it, at one start of a program; None: it passes."""
    cases = [*failure.before, failure.drawn]
    error = dict(judge.departures(body, cases)).get(len(cases) - 1)
    return None if error is None else replace(failure, finding=error.finding)


def _with_words(failure: Failure, words: str) -> Failure:
    return replace(failure, finding=replace(failure.finding, message=f"{failure.finding.message}; {words}"))
