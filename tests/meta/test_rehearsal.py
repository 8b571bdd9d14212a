"""A program is started for many cases at once, whatever its properties ask for next; a Python port is judged as before."""

import numpy as np
import pytest
from hypothesis import strategies as st

from conformance.findings import DepartureError
from conformance.judge import Judge, Tier
from conformance.protocol.port import Case, PortError
from conformance.protocol.stages import reference
from conformance.rehearsal import PreparedPort, prepare, rehearse
from conformance.run_suite import run_suite
from conformance.suite.properties import cases, find_property


class Program:
    """What a FolderPort is to a PreparedPort: counts its starts, and answers ``change``d."""

    name, dtype, kept = "program", "float32", None

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
    return run_suite(Judge(PreparedPort(program), Tier("some", 40, 5)), [stage])


def test_a_case_that_depends_on_an_answer_costs_no_start_of_its_own():
    program = Program()
    assert all(result.outcome == "passed" for result in judged(program))
    assert len(program.starts) <= 10


def test_the_same_twice_is_asked_twice():
    """One wrong bit at the second time shows, in the program's own second answer."""

    def second(job, number, outputs):
        seen = [case.inputs["color"].tobytes() + case.inputs["motion"].tobytes() for case in job[:number]]
        again = job[number].inputs["color"].tobytes() + job[number].inputs["motion"].tobytes() in seen
        return {**outputs, "warped": np.nextafter(outputs["warped"], np.float32(9))} if again else outputs

    failed = {result.id for result in judged(Program(second), "warp") if result.outcome == "failed"}
    assert "warp.the_same_twice" in failed
    assert "warp.agrees_with_the_reference" not in failed


def test_a_job_that_fails_as_a_whole_is_a_failure_though_each_case_passes():
    def crash(job, number, outputs):
        if len(job) > 30:
            raise PortError("ended by SIGSEGV")
        return outputs

    judge = Judge(PreparedPort(Program(crash)), Tier("some", 40, 5))
    body = find_property("warp.nothing_moves")
    some = [{"color": np.full((2, i + 1, 1), i / 64), "motion": np.zeros((2, i + 1, 2))} for i in range(40)]
    prepare(judge, some, body)
    for case in some[:-1]:
        judge.check(body, case)
    with pytest.raises(DepartureError, match=r"depends on the cases before: .* 40 in one job: ended by SIGSEGV"):
        judge.check(body, some[-1])


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
        judge.run("warp", case)
        if fails and case["color"].shape[1] > 5:
            judge.same("warp.warped", case["color"], case["color"] + 1)

    fails = False
    test(Judge(PreparedPort(Program()), Tier("some", 40, 5)))
    once = len(draws)
    assert 30 <= once <= 60
    fails = True
    with pytest.raises(DepartureError):
        test(Judge(PreparedPort(Program()), Tier("some", 40, 5)))
    assert len(draws) > 2 * once
    assert draws[-1] == (1, 6)


def test_nothing_is_prepared_for_a_port_in_this_process():
    class Plain(Program):
        def run_many(self, cases):
            raise AssertionError

    judge = Judge(Plain())
    rehearse(judge, None, None)
    assert judge.record.cases == 0
