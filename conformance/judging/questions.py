# SPDX-License-Identifier: MIT
"""Questions of properties to a port: an object answers at once, a program by one job for the questions of many cases."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from conformance.protocol.port import Abilities, Case, Outputs, Port, PortError, Unsupported, foreign_code
from stss_ref.weights import Weights

Talk = Generator[Any, Any, None]
"""A property on one of its cases: it yields questions, gets their answers, and raises an error if one is wrong."""
BATCH = 256
"""Most cases in one start of a program."""
BATCH_BYTES = 256 * 2**20
"""Most bytes of inputs in one start of a program."""


@dataclass(frozen=True)
class Question:
    """One call of a stage: ``inputs`` are any floats, which the port gets rounded to its arithmetic.

    Attributes:
        again: the question is asked a second time: after all others, so that a program has computed something else between.
    """

    stage: str
    inputs: Mapping[str, NDArray[Any]]
    weights: Weights | None = None
    again: bool = False


def ask(stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None, *, again: bool = False) -> Question:
    """Make a question for a property to yield: ``got = yield ...``."""
    return Question(stage, inputs, weights, again)


Answer = Outputs | PortError | None
"""None: the port was not asked, since its start failed at another case."""


RunMany = Callable[[Sequence[Case]], Sequence[Outputs | Unsupported]]


def answers_of(port: Port, abilities: Abilities, cases: Sequence[Case]) -> list[Answer]:
    """A port's answers to cases in this order: outputs, or an error. A program computes many of them at one start."""
    if (run_many := abilities.run_many) is None:
        return [_answer(port, case) for case in cases]
    return [answer for some in _batches(cases) for answer in _run_once(port.name, run_many, some)]


def _answer(port: Port, case: Case) -> Answer:
    """The answer of an object. Arrays are copied, since it may write to its inputs, or later to its outputs."""
    inputs = {name: array.copy() for name, array in case.inputs.items()}
    weights = None if case.weights is None else case.weights.convert(np.copy)
    try:
        with foreign_code():
            outputs = cast("object", port.run(case.stage, inputs, weights))
        if not isinstance(outputs, Mapping):
            return PortError(f"expected a dictionary of arrays, found {type(outputs).__name__}")
        by_name = cast("Mapping[object, object]", outputs)
        for name, array in by_name.items():
            if not isinstance(array, np.ndarray):
                return PortError(f"{name}: expected a NumPy array, found {type(array).__name__}")
        return {name: array.copy() for name, array in cast("Outputs", by_name).items()}
    except PortError as error:
        return error


def _run_once(name: str, run_many: RunMany, cases: Sequence[Case]) -> list[Answer]:
    """The answers of one start. If it fails at a case, that case is asked alone."""
    try:
        answers = run_many(cases)
    except PortError as error:
        if len(cases) == 1:
            return [error]
        at = len(cases) - 1 if error.at is None else error.at
        (alone,) = _run_once(name, run_many, [cases[at]])
        if not isinstance(alone, PortError):
            hint = "; that time is for all of them: --timeout gives more" if error.late else ""
            alone = PortError(f"passes alone, but failed as one of {len(cases)} in a job: {error}{hint}", late=error.late)
        elif not error.silent:
            alone.silent = False
        return [alone if number == at else None for number in range(len(cases))]
    return [_lacking(name, case) if isinstance(each, Unsupported) else each for case, each in zip(cases, answers, strict=True)]


def _lacking(port: str, case: Case) -> PortError:
    sizes = ", ".join(f"{name} {array.shape}" for name, array in case.inputs.items())
    return PortError(f"{port}: stage {case.stage} is unsupported with {sizes}, though not with others")


def _batches(cases: Sequence[Case]) -> list[list[Case]]:
    batches: list[list[Case]] = []
    room = 0
    for case in cases:
        size = sum(array.nbytes for array in case.inputs.values())
        if not batches or len(batches[-1]) == BATCH or size > room:
            batches.append([])
            room = BATCH_BYTES
        batches[-1].append(case)
        room -= size
    return batches


class Dialogue:
    """A property on one of its cases, up to the answers that it waits for.

    Args:
        talk: the property.
        case: its case.

    Attributes:
        drawn_case: its case.
        questions: those that it waits for; empty: it has ended.
    """

    def __init__(self, talk: Talk, case: Any):
        self.drawn_case = case
        self.questions: tuple[Question, ...] = ()
        self._talk = talk
        self._alone = False

    def go_on(self, answers: Sequence[Outputs] | None) -> None:
        """Pass the answers to its question, None to begin. Errors of the property are raised here."""
        value = None if answers is None else answers[0] if self._alone else tuple(answers)
        self.questions = ()
        try:
            questions = self._talk.send(value)
        except StopIteration:
            return
        self._alone = isinstance(questions, Question)
        self.questions = (questions,) if isinstance(questions, Question) else tuple(questions)


def repeat_questions(questions: Sequence[Question], times: int) -> list[Question]:
    """Each question as often as it is computed; the repetitions come after all others."""
    return [question if time == 0 else replace(question, again=True) for question in questions for time in range(times)]
