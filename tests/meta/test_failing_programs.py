"""A program that fails at the first case of a stage: the stage fails like any other, with its folder and replay; the others are judged."""

import shlex
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from conformance.command import conform
from conformance.protocol.program_port import FolderPort
from stss_ground.errors import InputError
from tests.tiers import thorough

PROGRAM = """
import os, sys
from pathlib import Path

def rrm(case):
    (case / "out").mkdir()
    mask, given = (bytearray((case / "in" / f"{{name}}.npy").read_bytes()) for name in ("valid", "rectangle"))
    data = 10 + int.from_bytes(mask[8:10], "little")
    width = eval(mask[10:data])["shape"][1]
    y, x, h, w = (int.from_bytes(given[i:i + 4], "little") for i in range(len(given) - 16, len(given), 4))
    for row in range(y, y + h):
        mask[data + row * width + x:data + row * width + x + w] = bytes(w)
    (case / "out" / "valid.npy").write_bytes(mask)

def answer(job):
    for case in sorted(Path(job).glob("[0-9]*")):
        stage = (case / "stage").read_text().strip()
        if stage in {stages!r}:
            print("no such device:", case, file=sys.stderr, flush=True)
            {fault}
        elif stage == "rrm":
            rrm(case)
        else:
            (case / "unsupported").touch()

if sys.argv[1] != "--serve":
    answer(sys.argv[1])
elif {serves}:
    print("stss serve 1", flush=True)
    for line in sys.stdin:
        answer(line.rstrip())
        print("done " + line.rstrip(), flush=True)
"""


@pytest.fixture
def judged(tmp_path, monkeypatch):
    """The result of ``stss conform`` with `PROGRAM`; jobs lie in ``jobs``."""
    (tmp_path / "jobs").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "jobs"))
    monkeypatch.chdir(tmp_path)

    def run(fault, stages, *options, serves=True):
        Path("port.py").write_text(PROGRAM.format(fault=fault, stages=stages, serves=serves))
        command = shlex.join([sys.executable, "-I", "-S", str(tmp_path / "port.py")])
        return CliRunner().invoke(conform, ["--exec", command, *options])

    return run


@pytest.mark.parametrize(
    ("fault", "serves", "words"),
    [
        ("os.abort()", True, "ended by SIGABRT while it served"),
        thorough("os.abort()", False, "ended by SIGABRT"),
        ("pass", True, "0000/out/valid.npy: missing"),
    ],
)
def test_a_stage_that_fails_at_once_has_a_folder_and_a_replay(judged, tmp_path, fault, serves, words):
    """No place is named that is not there, no job is left behind; the folder passes when the program is mended."""
    result = judged(fault, ["rrm"], "--stages", "rrm", "--fail-fast", serves=serves)
    assert result.exit_code == 1, result.output
    (folder,) = (Path(line.split(" --replay ")[1]) for line in result.output.splitlines() if " --replay " in line)
    assert words in result.output
    assert "no such device: 0000" in result.output
    assert words in (folder / "README.txt").read_text()
    again = judged(fault, ["rrm"], "--replay", str(folder), serves=serves)
    assert again.exit_code == 1
    assert words in again.output
    mended = judged("pass", [], "--replay", str(folder))
    assert mended.output == "rrm.valid: error / bound 0\n"
    assert not list((tmp_path / "jobs").iterdir())


def test_a_program_has_the_stages_that_it_answers_and_those_at_which_it_fails(judged, tmp_path):
    judged("os.abort()", ["warp", "holes"], "--replay", "nowhere")
    assert FolderPort([sys.executable, "-I", "-S", "port.py"], 60, keep=False).stages() == {"rrm", "warp", "holes"}
    assert not list((tmp_path / "jobs").iterdir())


def test_a_program_that_fails_everywhere_is_no_port(judged, tmp_path):
    """One error, not a hundred failures."""
    result = judged("os.abort()", ["rrm", "warp"], "--stages", "rrm,warp")
    assert isinstance(result.exception, InputError)
    words = "warp and each other stage that was asked for fails; --stages warp judges it alone; python: ended by SIGABRT"
    assert words in str(result.exception)
    assert "no such device" in str(result.exception)
    assert not list((tmp_path / "jobs").iterdir())


def test_a_program_that_hangs_is_asked_a_few_times_and_not_for_every_test(judged):
    """The rest of the stage is not judged, in one line."""
    result = judged("import time; time.sleep(99)", ["rrm"], "--stages", "rrm", "--timeout", "1", serves=False)
    assert result.exit_code == 1
    assert result.output.count("failed: rrm.") == 1, result.output
    assert "the run as a whole: failed: suite.programs_answer_in_time: not judged: 2 tests of stage rrm: " in result.output
