# SPDX-License-Identifier: MIT
"""``pytest conformance/suite --port ...``, as it is typed in a checkout and for an installed judge."""

import json
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.tiers import thorough

SUITE = Path(__file__).parents[2] / "conformance" / "suite"
FOLDER = [str(SUITE)]
INSTALLED = ["-p", "conformance.pytest_plugin", "--pyargs", "conformance.suite"]
PORT = """
from conformance.reference_port import ReferencePort

class Port(ReferencePort):
    def stages(self):
        return frozenset({"rrm"})
    def run(self, stage, inputs, weights=None):
        outputs = super().run(stage, inputs, weights)
        return outputs if max(inputs["valid"].shape) < 60 else {"valid": 1 - outputs["valid"]}
"""


def run(here, suite, *arguments):
    command = [sys.executable, "-m", "pytest", *suite, *arguments]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(here), str(SUITE.parents[1])])}
    return subprocess.run(command, cwd=here, env=environment, capture_output=True, text=True, check=False, timeout=200)


@pytest.fixture
def here(tmp_path):
    (tmp_path / "my_port.py").write_text(PORT)
    return tmp_path


@pytest.mark.thorough
def test_a_checkout_judges_a_port(here):
    """A wrong test fails with the judge's words and the command that runs it again; a known failure is excused; pytest writes JUnit."""
    entries = [{"test": "rrm.large_frames_agree_with_the_reference", "until": "2999-01-01", "reason": "https://example.org/1"}]
    (here / "known.json").write_text(json.dumps({"format": 1, "failures": entries}))
    options = ["--port", "my_port:Port", "--winograd", "-k", "rrm or warp and channels", "--junitxml", "junit.xml"]
    process = run(here, FOLDER, *options)
    assert process.returncode == 1, process.stdout + process.stderr
    assert "1 failed, 2 passed, 1 skipped" in process.stdout
    assert "rrm.valid: wrong at" in process.stdout
    folder = "conform-failures/rrm.large_frames_agree_with_the_reference"
    assert f"stss conform --port my_port:Port --winograd --replay {folder}" in process.stdout
    assert (here / folder / "README.txt").exists()
    suite = ElementTree.parse(here / "junit.xml").getroot()[0]
    assert [suite.get(name) for name in ("tests", "failures", "skipped")] == ["4", "1", "1"]
    process = run(here, INSTALLED, *options, "--known-failures", "known.json")
    assert process.returncode == 0, process.stdout + process.stderr
    assert "1 xfailed" in process.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "expected either --port package.module:factory or --exec PROGRAM"),
        thorough(["--port", "my_port:Nobody"], "module my_port has no Nobody"),
        thorough(["--port", "my_port:Port", "--known-failures", "nowhere"], "nowhere: No such file"),
    ],
)
def test_a_mistake_is_one_line(here, arguments, words):
    process = run(here, FOLDER, *arguments)
    assert process.returncode == 4
    assert words in process.stderr
    assert "Traceback" not in process.stderr


def test_a_run_in_which_nothing_was_judged_does_not_pass(here):
    process = run(here, FOLDER, "--port", "my_port:Port", "-k", "channels_do_not_mix")
    assert process.returncode == 1
    assert "nothing was judged: the port has none of the stages asked for" in process.stdout


@pytest.mark.thorough
def test_side_by_side_a_run_passes_if_anything_was_judged(here):
    """With pytest-xdist the workers have the results, and the process that decides has none."""
    good = run(here, FOLDER, "--port", "my_port:Port", "-k", "rrm and not large", "-n", "2")
    assert good.returncode == 0, good.stdout + good.stderr
    assert "nothing was judged" not in good.stdout
    for tests in ("one_colour", "channels_do_not_mix"):  # several, and a single one, which all its worker's tests are
        assert run(here, FOLDER, "--port", "my_port:Port", "-k", tests, "-n", "2").returncode == 1
