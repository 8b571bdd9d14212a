"""A stage that was added in part: what is missing is named by its file, as CONTRIBUTING lists the parts."""

from dataclasses import replace

import numpy as np
import pytest

from conformance.answers.by_stage import expect
from conformance.answers.port_arithmetic import Arithmetic
from conformance.cases.alike import alike_calls
from conformance.cases.large_inputs import large_inputs
from conformance.judging.judge import Judge
from conformance.protocol.stages import STAGES
from conformance.reference_port import ReferencePort
from conformance.suite import run_suite as suite
from tests.meta.samples import samples


@pytest.mark.parametrize(
    ("call", "file"),
    [
        (lambda: expect("new", {}, None, Arithmetic(), {}), "conformance/answers/by_stage.py"),
        (lambda: large_inputs("new")[0](np.random.default_rng(0)), "conformance/cases/large_inputs.py"),
        (lambda: alike_calls("new")(np.random.default_rng(0)), "alike.py"),
        (lambda: samples("new"), "tests/meta/samples.py"),
        (lambda: suite.run_suite(Judge(ReferencePort()), ["new"]), "suite/test_new.py"),
    ],
)
def test_a_part_that_is_missing_is_named(call, file, monkeypatch):
    monkeypatch.setitem(STAGES, "new", replace(STAGES["rrm"], name="new"))
    monkeypatch.setattr(suite, "SUITE", (*suite.SUITE, "new"))
    with pytest.raises(AssertionError, match=file):
        call()
