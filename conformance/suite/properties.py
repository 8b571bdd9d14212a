# SPDX-License-Identifier: MIT
"""Make tests of properties; a property is a function of the judge and of one case."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import wraps
from importlib import import_module
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.errors import Flaky

from conformance.cases.alike import Call, alike_calls, exchange_halves
from conformance.cases.constants import constant_cases, pinned_by
from conformance.cases.engine_inputs import engine_inputs
from conformance.cases.exact_weights import LAST, exact_inputs, rounded_sums
from conformance.cases.large_inputs import large_inputs, user_inputs
from conformance.cases.planes import Size
from conformance.explain.explain import explain
from conformance.judging.findings import DepartureError
from conformance.judging.judge import Body, Judge
from conformance.judging.questions import Talk, ask
from conformance.judging.search import DrawnCases, MadeCases, Maker, Makers
from conformance.protocol.stages import STAGES
from stss_ref.weights import Weights

Test = Callable[[Judge], None]


def cases(strategy: st.SearchStrategy[Any], *, slow: bool = False) -> Callable[[Body], Test]:
    """Make a test of a property on drawn cases: see `DrawnCases`."""
    return _test_on(DrawnCases(strategy, slow=slow))


def cases_of(
    makers: Makers | Callable[[Judge], Makers], *, about: Callable[[Maker], str] = lambda _: ""
) -> Callable[[Body], Test]:
    """Make a test of a property on a few cases that are made: see `MadeCases`."""
    return _test_on(MadeCases(makers, about))


def _test_on(source: DrawnCases | MadeCases) -> Callable[[Body], Test]:
    def decorate(body: Body) -> Test:
        @wraps(body)
        def test(judge: Judge) -> None:
            __tracebackhide__ = True
            with _confirm_failures(judge, body):
                source.check(judge, body)

        # pytest looks for fixtures in the signature, and the case is no fixture.
        property_test: Any = test
        del property_test.__wrapped__
        property_test.property, property_test.source = body, source
        return property_test

    return decorate


def agrees_in_large_frames(stage: str) -> Test:
    """Make a stage's test on as many large frames as the judge's tier says, and on one of the size that the judge is asked for."""
    words = "Large frames agree, too: with hundreds of columns or rows, more pixels than 16 bits count, and motion across them."
    return _agrees(stage, lambda judge: large_inputs(stage, judge.tier.large, judge.size, judge.largest_side), words)


def agrees_on_constants(stage: str) -> Test:
    """Make a stage's test on cases that each pin a constant."""
    words = "Cases agree, too, in which a constant shows: just beside a limit, or near a small number that is added or is a least value."
    return _agrees(stage, constant_cases(stage), words, pinned_by)


def agrees_on_engines(stage: str) -> Test:
    """Make a stage's test on inputs that no strategy draws."""
    words = "Cases agree, too, with motion of -0, stencils up to 65536, lost motion and positions, motions that no step needs."
    return _agrees(stage, engine_inputs(stage), words)


def _agrees(
    stage: str, makers: Makers | Callable[[Judge], Makers], words: str, about: Callable[[Maker], str] = lambda _: ""
) -> Test:
    def body(judge: Judge, case: Any) -> Talk:
        yield from judge.agrees(stage, *(case if STAGES[stage].weights else (case,)))

    body.__doc__ = words
    return cases_of(makers, about=about)(body)


def agrees_in_windows(stage: str) -> Test:
    """Make a stage's test on a frame of a user's size."""

    def body(judge: Judge, case: Any) -> Talk:
        """A frame of 720 x 1280 or 1080 x 1920 agrees, too, around the corners of tiles, and in its last rows."""
        yield from judge.agrees_in_windows(stage, *(case if STAGES[stage].weights else (case,)))

    def makers(judge: Judge) -> Makers:
        fine = judge.arithmetic.dtype == "float32"
        return user_inputs(stage, judge.tier.large, judge.largest_side, judge.stages, fine=fine)

    return cases_of(makers)(body)


def same_twice(stage: str, decorate: Callable[[Body], Test]) -> Test:
    """Make a stage's test that no answer depends on earlier cases."""

    def body(judge: Judge, case: Any) -> Talk:
        """The same inputs give the same bits again, after others of their size."""
        arguments = case if STAGES[stage].weights else (case,)
        between = ask(stage, exchange_halves(stage, arguments[0]), *arguments[1:])
        first, _, second = yield ask(stage, *arguments), between, ask(stage, *arguments, again=True)
        for name in first:
            judge.same(f"{stage}.{name}", np.nan_to_num(second[name]), np.nan_to_num(first[name]))

    return decorate(body)


def keeps_nothing_by_a_part(stage: str) -> Test:
    """Make a stage's test that what a port keeps from call to call, it keeps by all of its inputs."""

    def body(judge: Judge, calls: list[Call]) -> Talk:
        """Calls agree whose inputs share all but one pixel, one array, one weight or their sums with those of the call before."""
        first, *others = calls
        questions = [ask(stage, inputs, weights) for other in others for _, inputs, weights in (first, other)]
        answers = yield questions
        judge.compare(stage, *first[1:], answers[0])
        for (what, inputs, weights), outputs in zip(others, answers[1::2], strict=True):
            judge.record.about = f"the previous call differs only in this: {what}"
            judge.compare(stage, inputs, weights, outputs)
        judge.record.about = ""

    return cases_of([alike_calls(stage)])(body)


def agrees_exactly(stage: str, size: st.SearchStrategy[Size]) -> Test:
    """Make a stage's test on sums that no order of theirs rounds."""

    def body(judge: Judge, case: tuple[Any, Weights]) -> Talk:
        """Sums of eighths and few weights of 1 need no rounding in any order: they are right bit for bit."""
        yield from judge.agrees_exactly(stage, *case)

    return cases(exact_inputs(stage, size), slow=True)(body)


def rounds_either_way(stage: str, output: str) -> Test:
    """Make a stage's test of how the sums of the last layer before ``output`` are rounded."""

    def body(judge: Judge, case: tuple[Any, Weights]) -> Talk:
        """Thousands of sums of one layer are off by no more than rounding to nearest causes on average, and not all to one side."""
        yield from judge.rounds_either_way(stage, output, *case, LAST[stage])

    return cases(rounded_sums(stage), slow=True)(body)


@contextmanager
def _confirm_failures(judge: Judge, body: Body) -> Generator[None]:
    """Run a failure again before reporting it."""
    __tracebackhide__ = True
    try:
        yield
    except (DepartureError, Flaky) as error:
        if judge.shrink:
            judge.record.failure = explain(judge, body)
        raise DepartureError(judge.failure().finding) from error


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
