"""The schemas describe exactly the files that the code writes and reads."""

import copy
import json
from pathlib import Path

import jsonschema
import pytest

import conformance.report
from conformance.judging.judge import Judge, Tier
from conformance.judging.known_failures import KnownFailuresError, read_known
from conformance.mistakes import find
from conformance.report.case_archive import write_cases
from conformance.report.report import to_json
from conformance.suite.run_suite import run_suite
from stss.port import ReferencePort
from tests.meta.write_stages import COMMAND, texts

FOLDER = Path(conformance.report.__file__).parent / "schemas"
PAGE = Path(__file__).parents[2] / "docs" / "ports.md"
FEW = Tier("quick", 12, 3, 1)
KNOWN_FAILURES = {"format": 1, "failures": [{"test": "warp.the_same_twice", "until": "2999-01-01", "reason": "why"}]}

NAMED = {"stages", "inputs", "outputs", "layers", "error_over_bound"}
"""Objects whose keys are names of stages, arrays, outputs or layers."""


def schema(name):
    return json.loads((FOLDER / f"{name}.schema.json").read_text())


def faults(value, rules):
    return [f"{error.json_path}: {error.message[-200:]}" for error in jsonschema.Draft202012Validator(rules).iter_errors(value)]


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """Of each schema, what the code writes."""
    folder = tmp_path_factory.mktemp("schemas")
    judge = Judge(ReferencePort(), FEW)
    results = run_suite(judge, ["warp", "rrm", "erm"])
    wrong = Judge(find("warp_x_sign").port(), FEW, shrink=False)
    outcomes = run_suite(wrong, ["warp", "rrm"])
    cases = write_cases(folder / "cases", ["rrm", "history"], FEW)
    return {
        "results": to_json(judge, results, {}, len(results)),
        "cases": cases,
        "known-failures": KNOWN_FAILURES,
        "stages": json.loads((FOLDER / "stages.json").read_text()),
        "results of a wrong port": to_json(wrong, outcomes, {outcomes[0].id: folder}, len(outcomes), complete=False),
    }


def places(value, at=()):
    """Paths of all objects in it; of a list, or of what is named, those of the first."""
    if isinstance(value, dict):
        yield at
        for key in [*value][: 1 if at and at[-1] in NAMED else None]:
            yield from places(value[key], (*at, key))
    if isinstance(value, list) and value:
        yield from places(value[0], (*at, 0))


def at(value, path):
    for key in path:
        value = value[key]
    return value


@pytest.mark.parametrize("name", ["results", "cases", "known-failures", "stages", "results of a wrong port"])
def test_what_is_written_fits(samples, name):
    text = json.loads(json.dumps(samples[name], allow_nan=False))
    assert not faults(text, schema(name.split(" ")[0]))


@pytest.mark.parametrize("name", ["results", "cases", "known-failures", "stages"])
def test_less_or_more_does_not_fit(samples, name):
    """Each key of each object is needed, unless keys are names of stages, arrays, outputs or layers; and there is no other."""
    rules, sample = schema(name), samples[name]
    for path in places(sample):
        if path and path[-1] in NAMED:
            continue
        for key in at(sample, path):
            less = copy.deepcopy(sample)
            del at(less, path)[key]
            assert faults(less, rules), (path, key)
        more = copy.deepcopy(sample)
        at(more, path)["more"] = 1
        assert faults(more, rules), path


def test_what_follows_from_the_stages_is_written():
    for path, text in texts():
        assert path.read_text(encoding="utf-8") == text, f"{path}: {COMMAND} writes it"


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({}, ""),
        ({"until": "soon"}, "until: expected a day like 2026-12-31, got 'soon'"),
        ({"until": "20291231"}, "until: expected a day like 2026-12-31, got '20291231'"),
        ({"until": 7}, "until: expected"),
        ({"until": None}, "until: expected words, got 'None'"),
        ({"reason": ""}, "reason: expected words"),
        ({"reason": " "}, "known: failures[0]: reason: expected words, got ' '"),
        ({"test": ""}, "test: expected words"),
        ({"more": "x"}, "expected test, until, reason, got 'more' as well"),
    ],
)
def test_known_failures_are_read_as_their_schema_says(tmp_path, entry, words):
    text = {"format": 1, "failures": [{**KNOWN_FAILURES["failures"][0], **entry}]}
    (tmp_path / "known").write_text(json.dumps(text))
    message = ""
    try:
        read_known(tmp_path / "known")
    except KnownFailuresError as error:
        message = str(error)
    assert words in message
    assert bool(message) == bool(faults(text, schema("known-failures"))) == bool(entry)


def test_the_page_names_every_schema():
    for path in FOLDER.iterdir():
        assert f"conformance/report/schemas/{path.name}" in PAGE.read_text(), path.name
