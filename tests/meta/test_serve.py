"""A program that serves is judged as one that is started for each job: each fault of it is a failure, and reported."""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from conformance.protocol import served
from conformance.protocol.port import Case, PortError
from conformance.protocol.program_port import FolderPort
from tests.tiers import thorough

PROGRAM = """
import os, pathlib, sys, time
import numpy as np

def answer(job):
    for case in sorted(pathlib.Path(job).glob("[0-9]*")):
        (case / "out").mkdir()
        np.save(case / "out" / "valid.npy", np.load(case / "in" / "valid.npy"))

with open({starts!r}, "a") as file:
    print(*sys.argv[1:], file=file)
if sys.argv[1] != "--serve":
    answer(sys.argv[1])
    sys.exit()
print("stss serve 1", flush=True)
for number, line in enumerate(sys.stdin):
    job = line.rstrip("\\n")
    print("job", number, file=sys.stderr, flush=True)
    {lines}
    print("a word on the way", flush=True)
    print(f"done {{job}}", flush=True)
"""


def case(seed=0):
    valid = (np.random.default_rng(seed).random((3, 4)) < 0.5).astype(np.uint8)
    return Case("rrm", {"valid": valid, "rectangle": np.array([0, 0, 1, 1], np.int32)})


@pytest.fixture
def program(tmp_path, monkeypatch):
    """A port that is ``PROGRAM`` with some lines for each job; and the arguments of each of its starts."""
    (tmp_path / "jobs").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "jobs"))
    ports = []

    def make(lines="answer(job)", timeout=20.0, change=lambda text: text, *, keep=True):
        text = change(PROGRAM.format(starts=str(tmp_path / "starts"), lines=lines.replace("\n", "\n    ")))
        (tmp_path / "program.py").write_text(text)
        ports.append(FolderPort([sys.executable, str(tmp_path / "program.py")], timeout, keep=keep))
        return ports[-1]

    yield make
    for port in ports:
        port.restart()


def starts(tmp_path):
    return (tmp_path / "starts").read_text().split("\n")[:-1]


def test_one_process_computes_all_jobs(program, tmp_path):
    port = program()
    for seed in range(4):
        (got,) = port.run_many([case(seed)])
        np.testing.assert_array_equal(got["valid"], case(seed).inputs["valid"])
    assert port.stderr == "job 3"
    assert starts(tmp_path) == ["--serve"]
    assert not list((tmp_path / "jobs").iterdir())
    port.restart()
    port.run_many([case()])
    assert port.stderr == "job 0", "it remembers nothing"


def test_a_program_that_does_not_serve_is_started_for_each_job(program, tmp_path):
    port = program(change=lambda text: text.replace('"stss serve 1"', '"usage: program JOB"'))
    for _ in range(2):
        port.run_many([case()])
    first, *later = starts(tmp_path)
    assert first == "--serve"
    assert len(later) == 2
    assert "--serve" not in later


def test_a_program_that_waits_for_something_else_is_started_for_each_job(program, tmp_path, monkeypatch):
    monkeypatch.setattr(served, "READY_SECONDS", 1.5)
    port = program(change=lambda text: text.replace('print("stss serve 1", flush=True)', "time.sleep(60)"))
    port.run_many([case()])
    assert len(starts(tmp_path)) == 2


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        thorough("answer(job)\nif number == 1: time.sleep(60)", "stopped after 3 s"),
        ("answer(job)\nif number == 1: sys.exit(3)", "ended with status 3 while it served"),
        ("answer(job)\nif number == 1: os._exit(0)", "ended with status 0 while it served"),
        thorough("answer(job)\nif number == 1: os.kill(os.getpid(), 11)", "ended by SIGSEGV while it served"),
        ("answer(job)\nif number == 1: job += '_'", "answered for another job: expected"),
        ("if number != 1: answer(job)", "valid.npy: missing"),
        ("answer(job)\nwhile number == 1: print('x' * 9999)", "more than 1 MiB on its output"),
        ("answer(job)\nwhile number == 1: print('x' * 9999, file=sys.stderr)", "more than 1 MiB on its output"),
    ],
)
def test_what_goes_wrong_is_told_and_the_next_job_has_a_new_process(program, tmp_path, monkeypatch, lines, words):
    monkeypatch.setattr(served, "MOST_SAID", 1 << 20)
    port = program(lines, timeout=3 if "sleep" in lines else 20)
    port.run_many([case()])
    with pytest.raises(PortError, match=words) as error:
        port.run_many([case()])
    assert f"its job is kept: {port.kept_job}" in str(error.value)
    assert port.kept_job.parent == Path(tempfile.gettempdir())  # not in memory, where it would stay
    assert "job 1" in (port.kept_job / "stderr.txt").read_text()[:99]
    port.run_many([case(2)])
    again = 1 if "missing" in words else 2
    assert starts(tmp_path) == ["--serve"] * again


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("answer(job)", ""),
        ("answer(job.split()[0])", "valid.npy: missing"),
        ("answer(job.encode().decode('latin-1'))", "valid.npy: missing"),
    ],
)
def test_a_path_of_the_judge_has_spaces_and_letters_beyond_ascii(program, lines, words):
    port = program(lines, keep=False)
    if not words:
        (got,) = port.run_many([case()])
        np.testing.assert_array_equal(got["valid"], case().inputs["valid"])
        return
    with pytest.raises(PortError, match=words):
        port.run_many([case()])


def test_a_program_that_removes_its_job_while_it_serves_is_told(program):
    port = program("answer(job)\nimport shutil\nshutil.rmtree(job)")
    with pytest.raises(PortError, match="no such folder"):
        port.run_many([case()])


@pytest.mark.parametrize("keep", [True, False])
def test_our_own_port_serves(keep, monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONIOENCODING", "cp1252")  # as Windows has it
    starts = tmp_path / "starts"
    port = FolderPort(["sh", "-c", 'echo >> "$0"; exec "$@"', str(starts), sys.executable, "-m", "stss", "port"], 60, keep=keep)
    port.run_many([case()])
    (got,) = port.run_many([case(1)])
    assert got["valid"][0, 0] == 0
    assert starts.read_text() == "\n"
    port.restart()
    both = subprocess.run([sys.executable, "-m", "stss", "port"], capture_output=True, text=True, timeout=60, check=False)
    assert (both.returncode, both.stderr.strip()[-27:]) == (2, "either a job folder or --serve"[-27:])
