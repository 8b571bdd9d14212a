# SPDX-License-Identifier: MIT
"""Run a failure again, alone and after the cases before it, and say if it occurs only sometimes."""

from __future__ import annotations

from dataclasses import replace
from time import monotonic

from conformance.judging.findings import Failure, Finding
from conformance.judging.judge import Body, Judge

UNSTABLE = "differs from run to run"
CHANGES = "the port's answers change from run to run: uninitialised memory, a race, or state?"
AGAIN = 3
"""Runs in which a case must fail after others, each time, before the message says that it depends on them; a race does not."""
ALONE = 20
"""Times that a case is run alone if nothing makes it fail every time."""
MOST_SECONDS = 60.0
"""Most time for these runs."""


def confirm(judge: Judge, body: Body, small: Failure, first: Failure) -> Failure:
    """Confirm a failure; its message says if it does not fail alone, or fails with other bits.

    Args:
        judge: has the port.
        body: the property.
        small: the failure in its smallest form.
        first: the first failure, with the cases before it.

    Returns:
        The smallest case if that fails alone. Otherwise the first case that failed, with as few of the cases before it as it needs.
    """
    if (again := fails(judge, body, replace(small, before=()))) is not None:
        # Memory that was not written holds other numbers after other cases: the first failure had some before it.
        alone = fails(judge, body, replace(first, before=())) if first.drawn_case is not small.drawn_case else again
        changes = alone is None or _differs(first.finding, alone.finding) or _differs(small.finding, again.finding)
        return _with_words(again, CHANGES) if changes else again
    few = 1
    while first.before:
        before = first.before[-few:]
        after = replace(first, before=before)
        if all((again := fails(judge, body, after)) is not None for _ in range(AGAIN)):
            assert again is not None
            return _with_words(
                again, f"depends on the {f'{len(before)} cases' if len(before) > 1 else 'case'} before: it passes alone"
            )
        if len(before) == len(first.before):
            break
        few *= 2
    return _count_failures(judge, body, replace(first, before=()))


def _differs(one: Finding, other: Finding) -> bool:
    """Whether two answers to a case have other bits, or are wrong in another output."""
    if one.got is None or other.got is None:
        return False
    return one.output != other.output or one.got.tobytes() != other.got.tobytes()


def _count_failures(judge: Judge, body: Body, failure: Failure) -> Failure:
    """Run a case alone many times, and count its failures."""
    end = monotonic() + MOST_SECONDS
    times = times_wrong = 0
    latest = failure
    while times < ALONE and (monotonic() < end or not times):
        times += 1
        if (again := fails(judge, body, failure)) is not None:
            latest, times_wrong = again, times_wrong + 1
    cause = "" if times_wrong else ", so chance decides, or what the port computed before this test"
    return _with_words(latest, f"{UNSTABLE}: alone it is wrong {times_wrong} of {times} times{cause}")


def fails(judge: Judge, body: Body, failure: Failure) -> Failure | None:
    """The failure as it is now, after the cases before it, at one start of a program; None: it passes."""
    if judge.abilities.restart is not None:
        judge.abilities.restart()
    cases = [*failure.before, failure.drawn_case]
    error = dict(judge.departures(body, cases)).get(len(cases) - 1)
    return None if error is None else replace(failure, finding=error.finding)


def _with_words(failure: Failure, words: str) -> Failure:
    return replace(failure, finding=replace(failure.finding, message=f"{failure.finding.message}; {words}"))
