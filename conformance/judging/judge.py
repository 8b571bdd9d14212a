# SPDX-License-Identifier: MIT
"""The judge: it gives a port cases, compares its answers with the right ones, and records the largest error."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.by_stage import expect
from conformance.answers.expected import Expected, largest
from conformance.answers.port_arithmetic import Arithmetic, in_float64
from conformance.answers.sums import expect_rounding, rounding
from conformance.answers.windows import expect_windows
from conformance.judging.findings import MOST_WRONG, DepartureError, Failure, Finding, Record, WrongError, describe
from conformance.judging.questions import BATCH, Answer, Dialogue, Question, Talk, answers_of, ask, repeat_questions
from conformance.protocol.port import Abilities, Arrays, Case, Outputs, Port, PortError, abilities_of
from conformance.protocol.stages import STAGES, check_inputs, check_outputs, reference
from conformance.protocol.weights_file import shuffle
from conformance.protocol.weights_format import restrict
from conformance.tolerance import BOUNDS
from stss_ref.arrays import ArrayError
from stss_ref.weights import Weights

MOST_FLOAT16 = 1.0
MOST_SHADED = 8000.0
"""Times 8.1, the brightest material's share of light over the darkest's, it is a number of float16."""
RMS = "_rms"
"""Added to an output's name: the root mean square of all its errors, over its limit."""
MOST_BEFORE = BATCH - 1
"""Most cases that are remembered as those before a failure; together with the failing case they fill one run of a program."""
OTHERS = 6
"""Cases, besides a failure, that a mistake must also explain."""
MOST_SILENT = 2
"""Cases in a row that a program of one stage may leave unanswered for the whole of its time; the first is asked at two starts."""
MOST_ROUNDED = 2 * BATCH
"""Most inputs that are remembered in the form that the port gets: a program's cases are written first, and compared later."""
MOST_RIGHT, MOST_NUMBERS = 64, 2**16
"""Most right answers that are remembered, and most numbers in the inputs of each."""
MOST_WEIGHTS = 128
"""Most sets of weights that are remembered in the form that the port gets; one test has fewer."""


@dataclass(frozen=True)
class Tier:
    """Numbers of cases: ``fast`` of a fast property, ``slow`` of one that runs the network, at most ``large`` large frames."""

    name: str
    fast: int
    slow: int
    large: int = 1


TIERS = {"quick": Tier("quick", 200, 24, 4), "full": Tier("full", 500, 150, 99)}
Body = Callable[["Judge", Any], Talk]
"""A property: it asks the port about a case, and raises DepartureError if the property does not hold."""


class Judge:
    """Runs properties on a port.

    Args:
        port: to be judged.
        tier: number of cases.
        seed: of the cases; the same seed gives the same cases.
        shrink: make a failing case smaller.
        repeat: number of times that each case is computed; different bits in any of them are a departure.
        size: (H, W) at which each stage is also judged once; None: at the tier's sizes only.
        largest_side: the most rows or columns of an array that the port takes; larger cases are cut to that; None: any.
        abilities: the port's; None: the port's own statement.

    Attributes:
        record: of the test that runs now; the runner sets a new one before each test.
        tell: called with a failure that takes long to be made smaller.
        near: largest error / bound of each output in the last case.
        answers: the largest cases of this test that were compared with the reference, and the port's answers.
    """

    def __init__(
        self,
        port: Port,
        tier: Tier = TIERS["quick"],
        seed: int = 0,
        *,
        shrink: bool = True,
        repeat: int = 1,
        size: tuple[int, int] | None = None,
        largest_side: int | None = None,
        abilities: Abilities | None = None,
    ):
        self.port, self.tier, self.seed, self.shrink, self.repeat = port, tier, seed, shrink, repeat
        self.size, self.largest_side = size, largest_side
        self.abilities = abilities_of(port) if abilities is None else abilities
        self.arithmetic = Arithmetic(self.abilities.dtype, bool(self.abilities.winograd))
        self.weights_version = self.abilities.weights_version
        self.stages = port.stages()
        self.record = Record()
        self.tell: Callable[[Finding], None] = lambda _: None
        self.near: dict[str, float] = {}
        self.answers: list[tuple[Case, Outputs]] = []
        self._silent: Counter[str] = Counter()
        self._before: deque[Any] = deque(maxlen=MOST_BEFORE)
        self._rounded: dict[tuple[int, str], tuple[Arrays, dict[str, NDArray[Any]]]] = {}
        self._right: dict[tuple[str, int, int], tuple[Arrays, Weights, dict[str, Expected]]] = {}
        """By the identities of inputs and weights, which are kept alive."""
        self._weights: dict[int, tuple[Weights, Weights]] = {}

    def begin(self) -> None:
        """Begin another test: forget the record and cases of the last one."""
        self.record = Record()
        self._before.clear()
        self._rounded.clear()
        self.answers.clear()

    @property
    def is_program(self) -> bool:
        """Whether the port computes many cases at one start."""
        return self.abilities.run_many is not None

    def is_silent(self, stage: str) -> bool:
        """Whether the program has answered none of the stage's last cases in time: asking on would take hours."""
        return self._silent[stage] >= MOST_SILENT

    def check(self, body: Body, *cases: Any) -> None:
        """Run a property on some of its cases; DepartureError if it does not hold, with the failure in ``record``."""
        self.near = {}
        if self.first_wrong(body, cases) is not None:
            raise DepartureError(self.failure().finding)

    def failure(self) -> Failure:
        """The failure of the test that runs now."""
        assert self.record.failure is not None
        return self.record.failure

    def first_wrong(self, body: Body, cases: Sequence[Any]) -> int | None:
        """Number of the first case that is found wrong, whose failure is then in ``record``; None: all are right."""
        wrong: int | None = None
        for number, error in self.departures(body, cases):
            if error is None:
                continue
            self.record.wrong.append(error.finding)
            if wrong is None:
                wrong = number
                before = [*self._before, *cases[:number]][-MOST_BEFORE:]
                self.record.failure = Failure(error.finding, cases[number], tuple(before))
                self.record.first = self.record.first or self.record.failure
            # A program has answered the others, too.
            if not (self.is_program and self.shrink) or len(self.record.wrong) == MOST_WRONG:
                break
        self._before.extend(cases if wrong is None else cases[: wrong + 1])
        return wrong

    def departures(self, body: Body, cases: Sequence[Any]) -> Iterator[tuple[int, DepartureError | None]]:
        """Yield the number of each case when it ends, with its departure if it is wrong.

        A program computes the questions of all cases together, round by round; an object answers one case after the other.
        """
        dialogues = [(number, Dialogue(body(self, case), case)) for number, case in enumerate(cases)]
        for group in [dialogues] if self.is_program else [[each] for each in dialogues]:
            waiting: list[tuple[int, Dialogue]] = []
            for number, dialogue in group:
                if (error := self._advance(dialogue, None)) is not None or not dialogue.questions:
                    yield number, error
                else:
                    waiting.append((number, dialogue))
            while waiting:
                answers = self._ask([dialogue for _, dialogue in waiting])
                going = []
                for (number, dialogue), answer in zip(waiting, answers, strict=True):
                    if answer is None:
                        continue
                    error = answer if isinstance(answer, DepartureError) else self._advance(dialogue, answer)
                    if error is not None or not dialogue.questions:
                        yield number, error
                    else:
                        going.append((number, dialogue))
                waiting = going

    def _advance(self, dialogue: Dialogue, answers: Sequence[Outputs] | None) -> DepartureError | None:
        """Let a property go on to its next questions; a wrong answer is of its last question's case, if it names no other."""
        last = dialogue.questions[-1] if dialogue.questions else None
        try:
            dialogue.go_on(answers)
        except DepartureError as error:
            return error
        except WrongError as error:
            assert last is not None
            return error.of(self._case_of(last))
        except Exception as error:
            # A fault of the judge: its case is kept like any other failure.
            if last is not None:
                message = f"judging failed: {type(error).__name__}: {error}"
                self.record.failure = Failure(Finding(message, self._case_of(last), "", None, None), dialogue.drawn_case)
            raise
        return None

    def _case_of(self, question: Question) -> Case:
        return self.make_case(question.stage, question.inputs, question.weights)

    def _ask(self, dialogues: Sequence[Dialogue]) -> list[list[Outputs] | DepartureError | None]:
        """The port's answers for all waiting cases; a departure in place of a missing one; None if the port was not asked."""
        questions = [question for dialogue in dialogues for question in repeat_questions(dialogue.questions, self.repeat)]
        order = sorted(range(len(questions)), key=lambda i: questions[i].again)
        cases = [self._case_of(question) for question in questions]
        answer_of = dict(zip(order, answers_of(self.port, self.abilities, [cases[i] for i in order]), strict=True))
        answers = [self._check_answer(case, answer_of[i]) for i, case in enumerate(cases)]
        result: list[list[Outputs] | DepartureError | None] = []
        for dialogue in dialogues:
            count = len(dialogue.questions) * self.repeat
            some, answers = answers[:count], answers[count:]
            result.append(self._together(dialogue, some))
        return result

    def _together(self, dialogue: Dialogue, answers: Sequence[Outputs | DepartureError | None]) -> Any:
        """The answers to the questions of one case, each computed as often as the others with the same bits."""
        wrong = next((each for each in answers if isinstance(each, DepartureError)), None)
        if wrong is not None or any(each is None for each in answers):
            return wrong
        outputs_of = [each for each in answers if isinstance(each, dict)]
        first = outputs_of[:: self.repeat]
        for i, outputs in enumerate(outputs_of):
            question, right = dialogue.questions[i // self.repeat], first[i // self.repeat]
            for name, array in outputs.items() if i % self.repeat else ():
                try:
                    self.same(f"{question.stage}.{name}", np.nan_to_num(array), np.nan_to_num(right[name]))
                except WrongError as error:
                    return error.of(self._case_of(question))
        return first

    def _check_answer(self, case: Case, answer: Answer) -> Outputs | DepartureError | None:
        """The outputs, if their shapes and dtypes are right."""
        sizes = check_inputs(case.stage, case.inputs, "float32")
        if answer is None:
            return None
        self.record.count(sizes)
        silent = isinstance(answer, PortError) and answer.silent
        self._silent[case.stage] = self._silent[case.stage] + 1 if silent else 0
        try:
            if isinstance(answer, PortError):
                raise answer
            check_outputs(case.stage, answer, sizes)
        except (ArrayError, PortError) as error:
            late = isinstance(error, PortError) and error.late
            return DepartureError(Finding(f"{case.stage}: {error}", case, "", None, None, late=late))
        return answer

    def run(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Outputs:
        """Run the port on one case, outside of a property.

        Returns:
            The port's outputs, with the right shapes and dtypes.

        Raises:
            DepartureError: the port fails, or an output is missing or has the wrong shape or dtype.
        """
        case = self.make_case(stage, inputs, weights)
        (answer,) = answers_of(self.port, self.abilities, [case])
        got = self._check_answer(case, answer)
        if isinstance(got, DepartureError):
            raise got
        assert got is not None
        return got

    def make_case(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Case:
        """The case that the port gets for these inputs."""
        return Case(stage, self._round_once(inputs, stage), None if weights is None else self._weights_of(weights))

    def _weights_of(self, weights: Weights) -> Weights:
        """The weights as the port gets them, the same object for the same weights, so that a job has them once."""
        if id(weights) not in self._weights:
            if len(self._weights) == MOST_WEIGHTS:
                self._weights.clear()
            converted = restrict(weights.convert(self.arithmetic.normal), self.weights_version)
            self._weights[id(weights)] = weights, shuffle(converted, self.weights_version)
        return self._weights[id(weights)][1]

    def round_inputs(self, arrays: Arrays, stage: str = "") -> dict[str, NDArray[Any]]:
        """``arrays`` as the port gets them: float32, rounded to numbers that its arithmetic has.

        Stages of the network of a float16 port get no number beyond ``MOST_FLOAT16``, so that activations fit into float16, too; its
        stage reshade no colour beyond ``MOST_SHADED``.
        """
        most: dict[str, float] = {}
        if self.arithmetic.dtype == "float16" and stage in STAGES:
            most = dict.fromkeys(arrays, MOST_FLOAT16) if STAGES[stage].weights else {}
            most |= dict.fromkeys(("color", "warped"), MOST_SHADED) if stage == "reshade" else {}
        return {name: self.arithmetic.rounded(array, most.get(name)) for name, array in arrays.items()}

    def _round_once(self, arrays: Arrays, stage: str) -> dict[str, NDArray[Any]]:
        """`round_inputs`, kept for the last cases: a property asks and compares with the same mapping."""
        key = id(arrays), stage
        if key not in self._rounded:
            if len(self._rounded) == MOST_ROUNDED:
                self._rounded.pop(next(iter(self._rounded)))
            self._rounded[key] = arrays, self.round_inputs(arrays, stage)
        return self._rounded[key][1]

    def exactly(self, arrays: Arrays, stage: str) -> dict[str, NDArray[Any]]:
        """The numbers of ``round_inputs`` in float64, for the reference."""
        return in_float64(self._round_once(arrays, stage))

    def right(
        self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None, got: Outputs | None = None
    ) -> dict[str, Expected]:
        """The right answers for these inputs, by output: see ``conformance.answers.by_stage.expect``.

        Those of the network's stages, which take longest, are kept for small inputs: several tests have the same cases.
        """
        if weights is None:
            return expect(stage, self.exactly(inputs, stage), None, self.arithmetic, got or {})
        key = stage, id(inputs), id(weights)
        if key not in self._right:
            right = expect(stage, self.exactly(inputs, stage), self._weights_of(weights), self.arithmetic, got or {})
            if sum(array.size for array in inputs.values()) > MOST_NUMBERS:
                return right
            if len(self._right) == MOST_RIGHT:
                self._right.pop(next(iter(self._right)))
            self._right[key] = inputs, weights, right
        return self._right[key][2]

    def agrees(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Talk:
        """Ask the port, and raise DepartureError unless every output is within its bound of the float64 reference."""
        self.compare(stage, inputs, weights, (yield ask(stage, inputs, weights)))

    def compare(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None, outputs: Outputs) -> None:
        """Raise DepartureError unless every output is within its bound of the float64 reference."""
        case = self.make_case(stage, inputs, weights)
        expected = self.right(stage, inputs, weights, outputs)
        if not expected:
            self.record.unjudged += 1
            expected = {name: _finite(got) for name, got in outputs.items() if not np.isfinite(got).all()}
        else:
            self._remember(case, outputs)
        try:
            self._hold_all(stage, outputs, expected)
        except WrongError as error:
            raise error.of(case) from None

    def _hold_all(self, stage: str, outputs: Outputs, expected: Mapping[str, Expected]) -> None:
        """Hold every output, so that the report has a ratio of each; raise the WrongError of the first that is wrong."""
        first: WrongError | None = None
        for name, right in expected.items():
            try:
                self.holds(f"{stage}.{name}", outputs[name], right)
            except WrongError as error:
                first = first or error
        if first is not None:
            raise first

    def _remember(self, case: Case, outputs: Outputs) -> None:
        """Keep the largest cases: one that was made smaller until it barely fails tells few mistakes apart."""
        self.answers.append((case, outputs))
        if len(self.answers) > OTHERS:
            sizes = [sum(array.size for array in case.inputs.values()) for case, _ in self.answers]
            del self.answers[sizes.index(min(sizes))]

    def agrees_exactly(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights) -> Talk:
        """Run a case that needs no rounding, and expect the right bits.

        A Winograd port has its bounds, since its matrices have thirds, and so has one in bfloat16, whose 8 bits the sums exceed.
        """
        if self.arithmetic.winograd or self.arithmetic.dtype == "bfloat16":
            yield from self.agrees(stage, inputs, weights)
            return
        outputs = yield ask(stage, inputs, weights)
        right = reference(stage, self.exactly(inputs, stage), self._weights_of(weights))
        self._hold_all(stage, outputs, {name: self._exact(want) for name, want in right.items()})

    def rounds_either_way(
        self, stage: str, output: str, inputs: Mapping[str, NDArray[Any]], weights: Weights, layer: str
    ) -> Talk:
        """Compare all errors of an output with those of sums that round either way; the sums' terms, of ``layer``, have one sign.

        Stage erm gives each sum at 25 places, after a product and a quotient by the same weight: one of them counts.
        """
        got = (yield ask(stage, inputs, weights))[output]
        want, first = np.unique(
            reference(stage, self.exactly(inputs, stage), self._weights_of(weights))[output], return_index=True
        )
        sums = want != 0
        terms = int(np.prod(weights[f"{layer}.weight"].shape[1:]))
        behind = BOUNDS["sums.quotient"].roundings if stage == "erm" else 0
        imbalance = rounding(got.reshape(-1)[first][sums], want[sums], terms, self.arithmetic, behind)
        self.holds(f"{stage}.rounding", imbalance, expect_rounding(self.arithmetic))

    def agrees_in_windows(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Talk:
        """Ask for a large frame, and compare a few windows of it; a wrong one is not compared with mistakes, which takes long."""
        outputs = yield ask(stage, inputs, weights)
        rounded, converted = self._round_once(inputs, stage), None if weights is None else self._weights_of(weights)
        for window in expect_windows(stage, rounded, converted, self.arithmetic, outputs):
            parts = {name: outputs[name][place] for name, (place, _) in window.outputs.items()}
            try:
                self._hold_all(stage, parts, {name: right for name, (_, right) in window.outputs.items()})
            except WrongError as error:
                at = f"in the window at row {window.rows.start}, column {window.columns.start} of the inputs"
                raise WrongError(f"{error.message}, {at}", error.output, None, None) from None

    def same(self, output: str, got: NDArray[Any], want: NDArray[Any]) -> None:
        """Raise WrongError unless the numbers are equal; 0 equals -0, and a denormal number may be 0."""
        self.holds(output, got, self._exact(np.asarray(want)))

    def _exact(self, want: NDArray[Any]) -> Expected:
        return Expected(want, self.arithmetic.flushed(want))

    def holds(self, output: str, got: NDArray[Any], expected: Expected) -> None:
        """Raise WrongError unless ``got`` is right; ``output`` is ``stage.name``, as in the table of bounds."""
        self.record.undecided += expected.undecided
        ratios = {output: largest(expected, got), **({f"{output}{RMS}": expected.together(got)} if expected.rms < np.inf else {})}
        for name, ratio in ratios.items():
            self.record.worst[name] = max(ratio, self.record.worst.get(name, 0.0))
        if max(ratios.values()) > 1 and largest(closer := expected.closer(got), got) > 1:
            raise WrongError(describe(output, got, expected), output.rsplit(".", maxsplit=1)[-1], got, closer)
        for name, ratio in ratios.items():
            self.near[name] = max(ratio, self.near.get(name, 0.0))


def _finite(got: NDArray[Any]) -> Expected:
    """Check an answer that cannot be judged, since rounding decides on all of it: its numbers must be finite."""
    return Expected(np.where(np.isfinite(got), got, 0), 0.0)


def agreement(judge: Judge, case: Case) -> Talk:
    """The property of a case without another one: it agrees with the reference."""
    yield from judge.agrees(case.stage, case.inputs, case.weights)
