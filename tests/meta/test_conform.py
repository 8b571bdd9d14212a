# SPDX-License-Identifier: MIT
"""``stss conform`` as a porter types it."""

import importlib
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner

from conformance import OLDEST_HYPOTHESIS
from conformance.answers.expected import Expected, largest
from conformance.answers.network import expect_layers
from conformance.answers.port_arithmetic import Arithmetic
from conformance.judging.findings import DepartureError
from conformance.judging.judge import TIERS, Judge, Tier, agreement
from conformance.options import PortChoice
from conformance.protocol import write_job
from conformance.protocol.layers import LAYERS_OF
from conformance.protocol.load_port import load_port
from conformance.protocol.stages import STAGES
from conformance.protocol.weights_format import VERSION_KEY, format_metadata
from conformance.report.picture import draw
from conformance.suite.run_suite import run_suite
from stss.cli.main import stss
from stss.images.read_write import read_rgb
from stss.port import ReferencePort
from stss_ground import optional
from stss_ground.errors import InputError
from stss_lab.stress.inputs import exact
from stss_ref.constants import HOLE_FILLS
from stss_ref.weights import Weights
from tests.hostile.cases import call
from tests.meta.samples import AHEAD, samples

EXAMPLE = Path(__file__).parents[2] / "conformance" / "examples" / "cpp"
WRONG = """
import numpy as np
from stss.port import ReferencePort
from stss_ground.errors import InputError

class Port(ReferencePort):
    name = "wrong"
    def stages(self):
        return frozenset({"warp", "rrm"})
    def run(self, stage, inputs, weights=None):
        if stage == "warp":
            inputs = {**inputs, "motion": -inputs["motion"]}
        return super().run(stage, inputs, weights)

class Inverted(Port):
    def run(self, stage, inputs, weights=None):
        out = super().run(stage, inputs, weights)
        return {"valid": 1 - out["valid"]} if stage == "rrm" else out

class Crash(Port):
    def run(self, stage, inputs, weights=None):
        raise MemoryError("no device")

class Shape(Port):
    def run(self, stage, inputs, weights=None):
        return {name: array[:-1] for name, array in super().run(stage, inputs, weights).items()}

class Nothing: pass
class Second(Port): weights_version = 2
class Text(Port): weights_version = "3"
class NumPyDtype(Port): dtype = np.dtype("float32")
class Unknown(Port):
    def stages(self):
        return frozenset({"warp", "wrap"})
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder with a wrong port in it; a judge of few cases."""
    monkeypatch.setitem(TIERS, "quick", Tier("quick", 20, 4, 1))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "wrong_port.py").write_text(WRONG)
    monkeypatch.delitem(sys.modules, "wrong_port", raising=False)
    return tmp_path


def run(*arguments):
    return CliRunner().invoke(stss, ["conform", *arguments])


def test_the_reference_passes(here):
    outcome = run("--port", "stss.port:ReferencePort", "--stages", "rrm", "--json", "found.json")
    assert outcome.exit_code == 0, outcome.output
    data = json.loads((here / "found.json").read_text())
    assert data["passed"]
    assert {test["stage"] for test in data["tests"]} == {"rrm"}
    assert not (here / "conform-failures").exists()


def test_a_wrong_port_leaves_what_is_needed(here):
    outcome = run("--port", "wrong_port:Port", "--report", "page.html", "--junit", "junit.xml", "--json", "found.json")
    assert outcome.exit_code == 1
    assert "warp.agrees_with_the_reference: warp.warped: error / bound" in outcome.output
    assert "the port lacks it" in outcome.output
    folder = here / "conform-failures" / "warp.agrees_with_the_reference"
    color = np.load(folder / "0000" / "in" / "color.npy")
    assert max(color.shape) <= 2  # as small as it gets
    assert read_rgb(folder / "picture.png").size
    assert "--replay" in (folder / "README.txt").read_text()
    page = (here / "page.html").read_text()
    assert "departs from the specification" in page
    assert "data:image/png;base64," in page
    assert "the test expects" in page
    assert '<code>holes</code><td>valid<td class="n wrap">not judged: the port lacks the stage' in page
    suite = ElementTree.parse(here / "junit.xml").getroot().find("testsuite[@name='warp']")
    assert int(suite.get("failures")) > 0
    assert suite.find("properties/property[@name='seed']").get("value") == "0"
    body = suite.find("testcase[@name='warp.agrees_with_the_reference']/failure").text
    assert "the test expects" in body
    assert "--replay conform-failures/warp.agrees_with_the_reference" in body
    data = json.loads((here / "found.json").read_text())
    assert {test["outcome"] for test in data["tests"] if test["stage"] == "holes"} == {"skipped"}

    assert run("--port", "wrong_port:Port", "--replay", str(folder)).exit_code == 1
    assert run("--port", "stss.port:ReferencePort", "--replay", str(folder)).exit_code == 0


def test_a_failure_is_told_when_it_occurs(here):
    """The report counts all tests; the rest is not run, and the JSON says that it is incomplete."""
    outcome = run("--port", "wrong_port:Port", "--stages", "warp", "--fail-fast", "--json", "found.json")
    assert outcome.exit_code == 1
    assert re.search(r"^1 of \d+ tests: failed: warp\.agrees_with_the_reference: .* looks like", outcome.output, re.M)
    assert "stopped after 1 of" in outcome.output
    data = json.loads((here / "found.json").read_text())
    assert (data["complete"], data["passed"], len(data["tests"])) == (False, False, 1)


def test_each_output_of_a_wrong_answer_is_compared():
    """Not the first alone: later tests, of an answer against itself, would leave 0 for the others."""

    class Wrong(ReferencePort):
        def run(self, stage, inputs, weights=None):
            return {name: array + 1 for name, array in super().run(stage, inputs, weights).items()}

    judge, case = Judge(Wrong()), samples("encoder")[0]
    with pytest.raises(DepartureError, match=r"encoder\.x1"):
        judge.check(agreement, case)
    assert all(judge.record.worst[f"encoder.{name}"] > 1 for name in ("x1", "x2", "x3", "x4"))


def test_a_stage_that_is_required_and_lacking_is_a_failure(here):
    files = ("--junit", "junit.xml", "--report", "page.html")
    outcome = run("--port", "wrong_port:Port", "--stages", "rrm", "--require", "rrm,holes", *files)
    assert outcome.exit_code == 1
    assert "the run as a whole: failed: suite.required_stages_are_there: the port has no stage holes" in outcome.output
    assert " tests: failed" not in outcome.output
    assert "required_stages_are_there" in (here / "junit.xml").read_text()
    assert "0 of 3 tests failed: " in (here / "page.html").read_text(), "what the run as a whole lacks is no test"
    outcome = run("--port", "wrong_port:Port", "--stages", "rrm", "--require", "warp")
    assert outcome.exit_code == 1
    assert "not among the stages that are judged: warp" in outcome.output


def test_what_an_interrupted_run_found_is_left(here):
    """As if by Ctrl-C in the second test."""
    (here / "stopping.py").write_text(
        "from stss.port import ReferencePort\n"
        "class Port(ReferencePort):\n"
        "    calls = 0\n"
        "    def run(self, *given):\n"
        "        Port.calls += 1\n"
        "        if Port.calls > 22: raise KeyboardInterrupt\n"
        "        return super().run(*given)\n"
    )
    outcome = run("--port", "stopping:Port", "--stages", "rrm", "--json", "found.json")
    assert outcome.exit_code == 1
    assert "stopped after 1 of 3 tests" in outcome.output
    data = json.loads((here / "found.json").read_text())
    assert [test["outcome"] for test in data["tests"]] == ["passed"]
    assert not data["complete"]


class Old(ReferencePort):
    """Refuses weights of a later version."""

    def __init__(self, version):
        self.version = version

    def run(self, stage, inputs, weights=None):
        assert int(format_metadata(weights)[VERSION_KEY]) <= self.version
        return super().run(stage, inputs, weights)


@pytest.mark.parametrize("version", [1, 3, 4])
def test_a_port_is_given_the_weights_that_it_knows(version):
    for declares in (True, False):
        port = Old(version)
        if declares:
            port.weights_version = version
        judge = Judge(port, Tier("some", 2, 6, 0), shrink=False)
        (result,) = run_suite(judge, ["frame"], only="agrees_with")
        assert (result.outcome == "passed") == declares


def test_the_picture_of_a_large_frame_shows_its_worst_part():
    """Not a thousand rows of one column; and its scale reaches as far as the error does."""
    want = np.zeros((1000, 1, 3))
    got = want.copy()
    got[700, 0] = 1
    picture = draw(got, Expected(want, 1e-5))
    assert picture.pixels.shape[0] < 300
    assert picture.pixels.shape[1] > 180
    assert (picture.pixels[:, -30] == 255).all(axis=-1).any()
    assert "white 1e5" in picture.words
    assert "rows 640 to 759 and columns 0 to 0 of the frame" in picture.words


def write_known(here, names, until="2999-01-01"):
    entries = [{"test": name, "until": until, "reason": "https://example.org/1"} for name in names]
    (here / "known").write_text(json.dumps({"format": 1, "failures": entries}))


@pytest.mark.thorough
def test_known_failures(here):
    run("--port", "wrong_port:Inverted", "--stages", "rrm", "--json", "found.json")
    failures = [test["id"] for test in json.loads((here / "found.json").read_text())["tests"] if test["outcome"] == "failed"]
    assert len(failures) > 1
    write_known(here, [*failures, "holes.agrees_with_the_reference"])  # the last stage is not judged, and does not count
    outcome = run(
        "--port", "wrong_port:Inverted", "--stages", "rrm", "--known-failures", "known", "--junit", "junit.xml", "--fail-fast"
    )
    assert outcome.exit_code == 0, outcome.output
    counts = ElementTree.parse(here / "junit.xml").getroot()[0]
    assert (counts.get("failures"), counts.get("errors"), counts.get("skipped")) == ("0", "0", str(len(failures)))
    assert "known until 2999-01-01: https://example.org/1" in outcome.output
    # After that day they are failures again.
    write_known(here, failures, "2020-02-29")
    outcome = run("--port", "wrong_port:Inverted", "--stages", "rrm", "--known-failures", "known")
    assert outcome.exit_code == 1
    assert "known until 2020-02-29, which is past: https://example.org/1" in outcome.output
    # On a right port the list is wrong, and the report says so.
    write_known(here, failures)
    outcome = run("--port", "stss.port:ReferencePort", "--stages", "rrm", "--known-failures", "known", "--junit", "junit.xml")
    assert outcome.exit_code == 1
    assert "take it off the list" in outcome.output
    assert ElementTree.parse(here / "junit.xml").getroot()[0].get("failures") == str(len(failures))
    write_known(here, ["warp.no_such_test"])
    text = call("conform", "--port", "wrong_port:Port", "--stages", "rrm", "--known-failures", "known").stderr
    assert "known failures: no such test: warp.no_such_test" in text


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("\nraise RuntimeError('at import')", "RuntimeError: at import (odd.py, line 2)"),
        ("import sys\nsys.exit(5)", "SystemExit: 5 (odd.py, line 2)"),
        ("def x(:", "SyntaxError: invalid syntax (odd.py, line 1)"),
        ("import helper_of_mine", "No module named 'helper_of_mine' (odd.py, line 1)"),
        ("class P:\n    def __init__(self): raise OSError('no GPU')", "OSError: no GPU (odd.py, line 2)"),
        ("class P:\n    def __init__(self, device): pass", "missing 1 required positional argument: 'device'"),
        ("P = 3", "expected a class or a function that makes the port, found int"),
        (
            "class P:\n    name, dtype, run = 'p', 'float32', None\n    def stages(self): return None",
            "odd:P: TypeError: 'NoneType'",
        ),
    ],
)
def test_a_port_that_does_not_load_is_one_line(tmp_path, monkeypatch, source, words):
    (tmp_path / "odd.py").write_text(source)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "odd", raising=False)
    importlib.invalidate_caches()
    with pytest.raises(InputError) as error:
        load_port(PortChoice("odd:P"))
    assert words in str(error.value)
    assert "odd:P: " in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "expected either --port"),
        (["--port", "a:b", "--exec", "c"], "expected either --port"),
        (["--port", "wrong_port"], "expected package.module:factory, got 'wrong_port'"),
        (["--port", "no_such_module:Port"], "No module named 'no_such_module'"),
        (["--port", "wrong_port:Prot"], "module wrong_port has no Prot"),
        (["--port", "wrong_port:Nothing"], "without name, dtype, stages, run"),
        (["--port", "wrong_port:NumPyDtype"], "dtype: expected the text float32, float16 or bfloat16, got dtype('float32')"),
        (["--port", "wrong_port:Unknown"], "stages: not in the table: wrap"),
        (["--port", "wrong_port:Second"], "wrong_port:Second: weights_version: expected 1, 3, 4 or 5, got 2"),
        (["--port", "wrong_port:Text"], "wrong_port:Text: weights_version: expected 1, 3, 4 or 5, got '3'"),
        (["--port", "wrong_port:Port", "--weights-version", "2"], "weights_version: expected 1, 3, 4 or 5, got 2"),
        (["--exec", "./no_such_program"], "./no_such_program: cannot be started"),
        (["--exec", "'"], "--exec: No closing quotation"),
        (["--exec", ""], "'--exec': expected a name, got an empty text"),
        (["--port", "wrong_port:Port", "--stages", "wrap"], "--stages: expected some of motion_chain"),
        (["--port", "wrong_port:Port", "--replay", "nowhere"], "nowhere: no such folder"),
        (["--port", "wrong_port:Port", "--known-failures", "nowhere"], "nowhere: No such file"),
        (["--port", "wrong_port:Port", "--json", "nowhere/found.json"], "nowhere/found.json: expected a file in a folder"),
        (["--port", "wrong_port:Port", "--report", "."], ".: expected a file"),
        (["--port", "wrong_port:Port", "--junit", "nowhere/junit.xml"], "nowhere/junit.xml: expected a file"),
        (["--port", "wrong_port:Port", "--failures", "wrong_port.py"], "wrong_port.py: expected a folder"),
        (["--write-cases", "cases", "--port", "a:b"], "expected neither --port nor --exec"),
        (["--write-cases", "cases", "--stages", "wrap"], "--stages: expected some of"),
        (["--write-cases", "."], "does not exist yet"),
        (["--write-cases", "nowhere/cases"], "in a folder that exists"),
    ],
)
def test_mistakes_are_one_line(here, arguments, words):
    outcome = call("conform", *arguments)
    assert outcome.returncode == 2
    assert words in outcome.stderr
    assert len(outcome.stderr.splitlines()) == 1


@pytest.mark.parametrize(("port", "words"), [("Crash", "MemoryError: no device"), ("Shape", "expected shape")])
def test_a_port_that_breaks_is_judged(here, port, words):
    """It neither ends the run nor passes."""
    outcome = run("--port", f"wrong_port:{port}", "--stages", "rrm")
    assert outcome.exit_code == 1
    assert words in outcome.output


def test_seeds_differ_and_repeat():
    def worst(seed):
        results = run_suite(Judge(ReferencePort(), Tier("some", 20, 2), seed), ["warp"], only="agrees_with")
        return [result.record.worst for result in results]

    assert worst(1) == worst(1) != worst(2)


def test_the_nearest_right_answer_counts():
    expected = Expected(np.array([[1.0, 2.0], [np.nan, 1.0]]), 0.5, (np.array([[5.0, 6.0], [np.nan, 1.0]]),), vectors=True)
    assert largest(expected, np.array([[5.0, 6.25], [3.0, np.inf]])) == 0.5
    assert largest(expected, np.array([[1.0, 6.0], [np.nan, 1.0]])) > 1  # half of one, half of the other
    assert largest(expected, np.array([[1.0, 2.0], [0.0, 1.0]])) == np.inf
    assert largest(expected, np.zeros((1, 2))) == np.inf


def test_where_rounding_decides_between_ranges_an_error_within_them_is_none():
    """It would hide how near the port comes to the bounds elsewhere; beyond them it is one."""
    expected = Expected(np.zeros((1, 2, 3)), np.array([[[0.5], [4.0]]]), free=np.array([[[False], [True]]]))
    assert expected.undecided == 3
    assert expected.part((slice(0, 1), slice(1, 2))).undecided == 3
    assert expected.ratios(np.array([[3 * [0.25], 3 * [4.0]]])).tolist() == [[3 * [0.5], 3 * [0.0]]]
    assert expected.ratios(np.array([[3 * [0.25], 3 * [8.0]]])).tolist() == [[3 * [0.5], 3 * [2.0]]]


@pytest.mark.skipif(not shutil.which("make") or not shutil.which("g++"), reason="needs make and g++")
@pytest.mark.thorough
def test_the_example_in_cpp_passes(tmp_path):
    """As a porter builds it: some cases of all its stages, each batch of cases at one start; what agrees has the other properties."""
    shutil.copytree(EXAMPLE, tmp_path / "cpp", ignore=shutil.ignore_patterns("port"))
    subprocess.run(["make", "-s"], cwd=tmp_path / "cpp", check=True)
    port, _ = load_port(PortChoice(program=str(tmp_path / "cpp" / "port"), timeout=60))
    for stage, names in LAYERS_OF.items():
        case = samples(stage)[0]
        right = expect_layers(stage, exact(case.inputs), case.weights, Arithmetic())
        layers = port.layers(stage, case.inputs, case.weights)
        assert list(layers) == list(names)
        assert max(largest(right[name], layers[name]) for name in names) <= 1
    assert port.stages() == set(STAGES) - AHEAD
    results = run_suite(Judge(port, Tier("some", 4, 1, 0)), sorted(port.stages()), only="agrees_with")
    assert not [f"{result.id}: {result.message}" for result in results if result.outcome != "passed"]
    detailed = [
        replace(case, weights=Weights(case.weights, "detail", hole_fill=fill))
        for case, fill in zip(samples("frame"), cycle(HOLE_FILLS))
    ]
    Judge(port).check(agreement, *detailed)
    write_job(tmp_path / "job", detailed[:1])
    (file,) = tmp_path.glob("job/0000/in/*.safetensors")
    whole = file.read_bytes()
    messages = {b"1": "no such entry in version 1", b"2": "expected stss_weights_version", b"3": "expected newest,"}
    for version, words in messages.items():
        file.write_bytes(whole.replace(b'"4"', b'"' + version + b'"'))
        outcome = subprocess.run([tmp_path / "cpp" / "port", tmp_path / "job"], capture_output=True, text=True, check=False)
        assert (outcome.returncode, outcome.stderr.count("\n")) == (2, 1)
        assert words in outcome.stderr


@pytest.mark.parametrize("found", ["6.100.8", "6.130.13", "5.200.0"])
def test_an_old_hypothesis_is_refused(monkeypatch, found):
    """Its cases are not those that are asked for, so mistakes would pass."""
    monkeypatch.setattr(optional, "version", lambda _: found)
    result = CliRunner().invoke(stss, ["conform", "--port", "stss.port:ReferencePort"])
    assert isinstance(result.exception, InputError)
    assert str(result.exception).startswith(f"hypothesis: expected version 6.131 or newer, found {found}: pip install")


@pytest.mark.parametrize("found", ["6.131.0", "6.140.2", "7.0"])
def test_a_newer_hypothesis_is_not(monkeypatch, found):
    monkeypatch.setattr(optional, "version", lambda _: found)
    optional.require("hypothesis", oldest=OLDEST_HYPOTHESIS)


@pytest.mark.parametrize("file", ["pyproject.toml", "packaging/judge/pyproject.toml"])
def test_the_packages_ask_for_the_oldest_hypothesis_that_does(file):
    text = (Path(__file__).parents[2] / file).read_text(encoding="utf-8")
    assert {*re.findall(r"hypothesis>=([\d.]+)", text)} == {".".join(map(str, OLDEST_HYPOTHESIS))}
