"""A program is started for many cases at once, for any questions of its properties; a Python port is judged as before."""

import numpy as np
import pytest
from hypothesis import strategies as st

from conformance.judging.findings import DepartureError, Finding
from conformance.judging.judge import Judge, Tier
from conformance.judging.questions import ask
from conformance.protocol.port import Case, PortError
from conformance.protocol.program_port import smallest_case
from conformance.protocol.stages import reference
from conformance.suite.properties import cases, find_property
from conformance.suite.run_suite import run_suite
from stss.port import ReferencePort


class Program:
    """In the place of a FolderPort: counts its starts, and answers ``change``d."""

    name, dtype, folder = "program", "float32", None

    def __init__(self, change=lambda job, number, outputs: outputs):
        self.starts, self._change = [], change

    def stages(self):
        return frozenset({"rrm", "warp"})

    def run_many(self, cases):
        self.starts.append(len(cases))
        outputs = [reference(case.stage, case.inputs, case.weights) for case in cases]
        return [self._change(cases, number, output) for number, output in enumerate(outputs)]

    def run(self, stage, inputs, weights=None):
        return self.run_many([Case(stage, inputs, weights)])[0]


def judged(program, stage="rrm"):
    return run_suite(Judge(program, Tier("some", 40, 5)), [stage])


def test_a_case_that_depends_on_an_answer_costs_no_start_of_its_own():
    program = Program()
    assert all(result.outcome == "passed" for result in judged(program))
    assert len(program.starts) <= 10


def test_the_same_twice_is_asked_twice():
    """One wrong bit at the second time shows, in the program's own second answer."""

    def second(job, number, outputs):
        digests = [case.inputs["color"].tobytes() + case.inputs["motion"].tobytes() for case in job[:number]]
        again = job[number].inputs["color"].tobytes() + job[number].inputs["motion"].tobytes() in digests
        return {**outputs, "warped": np.nextafter(outputs["warped"], np.float32(9))} if again else outputs

    failures = {result.id for result in judged(Program(second), "warp") if result.outcome == "failed"}
    assert "warp.the_same_twice" in failures
    assert "warp.agrees_with_the_reference" not in failures


def still(columns):
    return {"color": np.full((2, columns, 1), columns / 64), "motion": np.zeros((2, columns, 2))}


def test_a_job_that_fails_as_a_whole_is_a_failure_though_its_cases_pass():
    def crash(job, number, outputs):
        if len(job) > 30:
            raise PortError("ended by SIGSEGV", 20)
        return outputs

    program = Program(crash)
    with pytest.raises(DepartureError, match="passes alone, but failed as one of 40 in a job: ended by SIGSEGV"):
        Judge(program).check(find_property("warp.whole_pixels_move_exactly"), *(still(i + 1) for i in range(40)))
    assert program.starts == [40, 1]


def test_a_slow_program_is_told_of_its_time_and_not_of_chance():
    def slow(job, number, outputs):
        if len(job) > 30 and number == 20:
            raise PortError("stopped after 2 s", number, late=True)
        return outputs

    program = Program(slow)
    results = judged(program, "warp")
    failed = [result for result in results if result.outcome == "failed"]
    assert failed
    for result in failed:
        assert "passes alone" in result.message
        assert "--timeout gives more" in result.message
        assert "chance" not in result.message
    assert len(program.starts) < 60


def test_the_case_at_which_a_job_failed_is_found_at_one_more_start():
    def crash(job, number, outputs):
        if outputs["warped"].shape[1] == 8:
            raise PortError("ended by SIGSEGV", number)
        return outputs

    program = Program(crash)
    judge = Judge(program)
    with pytest.raises(DepartureError, match="warp: ended by SIGSEGV"):
        judge.check(find_property("warp.whole_pixels_move_exactly"), *(still(i + 1) for i in range(40)))
    assert program.starts == [40, 1]
    assert judge.record.failure.drawn_case["color"].shape == (2, 8, 1)


def test_what_is_asked_together_is_computed_together():
    """Calls of a sequence stay one after the other; what is asked again comes after all others."""
    questions = []

    def note(job, number, outputs):
        questions.append(job[number].inputs["color"].shape[1])
        return outputs

    def body(judge, columns):
        yield ask("warp", still(columns)), ask("warp", still(columns + 1)), ask("warp", still(columns), again=True)
        yield ask("warp", still(columns + 5))

    program = Program(note)
    Judge(program).check(body, 10, 20)
    assert program.starts == [6, 2]
    assert questions == [10, 11, 20, 21, 10, 20, 15, 25]


def test_making_a_case_smaller_ends_in_time_and_says_so(monkeypatch):
    """With the smallest failure so far, which has been told before."""
    clock = iter(range(10**6))
    monkeypatch.setattr("conformance.judging.search.monotonic", lambda: float(next(clock)))
    monkeypatch.setattr("conformance.judging.search.SHRINK_SECONDS", 12.0)

    def wrong(job, number, outputs):
        if outputs["warped"].shape[1] == 5:
            raise PortError("no frames of 5 columns", number)
        return outputs

    program, messages = Program(wrong), []
    judge = Judge(program)
    judge.tell = messages.append
    results = run_suite(judge, ["warp"], first_only=True)
    assert "no frames of 5 columns" in results[-1].message
    assert [finding.message for finding in messages] == ["warp: no frames of 5 columns"]
    assert len(program.starts) < 30


def test_cases_are_drawn_once_unless_one_fails():
    """Drawing takes as long as judging."""
    draws = []

    def counted(shape):
        draws.append(shape)
        return {"color": np.full((*shape, 1), 0.5), "motion": np.zeros((*shape, 2))}

    strategy = st.tuples(st.integers(1, 9), st.integers(1, 9)).map(counted)

    @cases(strategy)
    def test(judge, case):
        """Its frame has few columns."""
        yield ask("warp", case)
        if fails and case["color"].shape[1] > 5:
            judge.same("warp.warped", case["color"], case["color"] + 1)

    fails = False
    test(Judge(Program(), Tier("some", 40, 5)))
    once = len(draws)
    assert 30 <= once <= 60
    cases(strategy, slow=False)(test.property)(Judge(Program(), Tier("some", 40, 5)))
    assert len(draws) == once, "another test of the same strategy has the same cases"
    test(Judge(Program(), Tier("some", 40, 5), seed=1))
    assert len(draws) >= once + 30, "another seed has others"
    once = len(draws)
    fails = True
    with pytest.raises(DepartureError):
        test(Judge(Program(), Tier("some", 40, 5)))
    assert len(draws) > once
    assert draws[-1] == (1, 6)


def test_what_is_not_made_smaller_ends_at_the_first_failure():
    """Though the errors of right answers could be steered on."""
    answers = []

    @cases(st.tuples(st.integers(0, 10**6), st.integers(0, 10**6)))
    def test(judge, numbers):
        answers.append(max(numbers) > 999_900)
        judge.near = dict(zip("ab", numbers, strict=True))
        if answers[-1]:
            raise DepartureError(Finding("too much", smallest_case("warp"), "warped", None, None))
        yield from ()

    with pytest.raises(DepartureError):
        test(Judge(ReferencePort(), Tier("some", 400, 5), shrink=False))
    assert sum(answers) == 1
