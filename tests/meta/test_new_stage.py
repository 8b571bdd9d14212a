"""A stage that was added in part: what is missing is named by its file, as CONTRIBUTING lists the parts."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conformance.answers.by_stage import expect
from conformance.answers.port_arithmetic import Arithmetic
from conformance.cases.alike import alike_calls
from conformance.cases.large_inputs import large_inputs
from conformance.explain.terms import TERMS
from conformance.judging.judge import Judge
from conformance.mistakes import MISTAKES
from conformance.protocol.stages import STAGES
from conformance.reference_port import ReferencePort
from conformance.suite import run_suite as suite
from tests.meta.samples import AHEAD, samples

ROOT = Path(__file__).parents[2]
EXAMPLES = {
    "conformance/examples/cpp/port.cpp": '{"STAGE", run_STAGE}',
    "conformance/examples/cpp/README.md": "| `STAGE` |",
    "examples/webgpu/port.py": '"STAGE": ',
    "examples/webgpu/README.md": "`STAGE",
}
"""A file of the example ports, and how it names a stage."""


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


def test_every_stage_has_mistakes_and_every_one_of_image_space_terms():
    assert {mistake.stage for mistake in MISTAKES} == {*STAGES}, "conformance/mistakes/__init__.py"
    assert {*TERMS} == {stage.name for stage in STAGES.values() if not stage.weights}, "conformance/explain/terms.py"


def test_every_bound_of_the_answers_is_derived_on_the_page():
    answers = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "conformance" / "answers").glob("*.py"))
    page = (ROOT / "docs" / "conformance.md").read_text(encoding="utf-8")
    missing = [name for name in re.findall(r'BOUNDS\["([^"]+)"\]', answers) if f"`{name}`" not in page]
    assert not missing, f"docs/conformance.md: expected a paragraph that derives {', '.join(missing)}"


@pytest.mark.parametrize("file", EXAMPLES)
def test_every_stage_is_in_the_examples(file):
    """Before their own tests, which need a compiler or a device, say so."""
    text = (ROOT / file).read_text(encoding="utf-8")
    missing = [stage for stage in STAGES if stage not in AHEAD and EXAMPLES[file].replace("STAGE", stage) not in text]
    assert not missing, f"{file}: expected {', '.join(missing)}, or AHEAD of tests/meta/samples.py to name it"
