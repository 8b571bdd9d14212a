"""The job template for farms, with `stss gather`, makes the files of one run."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from stss.frames.backends import open_backend
from stss.run.gather import gather
from stss.run.job import run
from stss.run.options import RunOptions
from stss.sequence.reader import open_sequence
from stss.weights.file import BILINEAR, load
from stss_ground.errors import InputError
from stss_ground.output.folder import SUMS
from stss_ground.version import VERSION
from tests.app.conftest import PLAIN, files
from tests.hostile.cases import call

ROOT = Path(__file__).parents[3]
TEMPLATE = ROOT / "examples" / "farm" / "stss.openjd.yaml"

WEIGHTS = load(BILINEAR)


@pytest.fixture
def openjd():
    program = Path(sys.executable).with_name("openjd")
    if not program.exists():
        pytest.skip("no openjd-cli: pip install --group test")
    return program


@pytest.fixture
def frames(write_frames):
    return write_frames(range(8), rendered={0, 2, 4, 6}, size=(8, 8))


def plain(frames, out, numbers=None, **options):
    return run(
        open_sequence(frames, "stss"), out, open_backend("ref", WEIGHTS), WEIGHTS.label, RunOptions(frames=numbers, **options)
    )


@pytest.fixture
def parts(frames, tmp_path):
    """Two parts, and the files of one run in ``one``."""
    plain(frames, tmp_path / "parts" / "0", (0, 4))
    plain(frames, tmp_path / "parts" / "1", (5, 7))
    plain(frames, tmp_path / "one")
    return tmp_path / "parts"


def openjd_run(openjd, tmp_path, words):
    """``openjd run`` with these words, in a folder that has the examples."""
    (tmp_path / "bin").mkdir()
    for name, arguments in (("stss", " -m stss"), ("python", "")):
        command = tmp_path / "bin" / name
        command.write_text(f'#!/bin/sh\nexec "{sys.executable}"{arguments} "$@"\n')
        command.chmod(0o755)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    environment = {**os.environ, "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    command = [openjd, "run", *words]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path, check=False)


def gather_words(frames, out, last=7):
    parameters = {"Frames": frames, "Out": out, "Profile": "stss", "First": 0, "Last": last, "Chunk": 5, "LastTask": last // 5}
    parameters["Options"] = " ".join(PLAIN)
    return [TEMPLATE, "--step", "Gather", "--run-dependencies", *(w for n, v in parameters.items() for w in ("-p", f"{n}={v}"))]


@pytest.mark.thorough
def test_the_command_of_the_page_runs_as_it_stands(openjd, write_frames, device, tmp_path):
    write_frames(range(12), rendered=range(0, 12, 2), size=(8, 8), folder="frames")
    text = (ROOT / "docs" / "farm.md").read_text(encoding="utf-8")
    name, run, *words = shlex.split(re.search(r"^openjd run (?:.*\\\n)*.*$", text, re.M)[0].replace("\\\n", " "))
    assert (name, run) == ("openjd", "run")
    result = openjd_run(openjd, tmp_path, words)
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr
    assert sorted(path.name for path in (tmp_path / "out").glob("frame.*")) == [f"frame.{n:04d}.png" for n in range(12)]


def test_the_tasks_make_what_one_run_makes(openjd, frames, tmp_path):
    """In a folder whose name is a shell command; no shell runs it."""
    out = tmp_path / "out $(touch here); `touch here`"
    result = openjd_run(openjd, tmp_path, gather_words(frames, out))
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr
    plain(frames, tmp_path / "one")
    assert files(out) == files(tmp_path / "one")
    assert not list(ROOT.glob("here"))
    assert not list(tmp_path.rglob("here"))


def test_the_tasks_write_nothing_among_their_frames(openjd, frames, tmp_path):
    for path in frames.iterdir():
        path.rename(path.with_name(path.name.replace("seq", "frame")))
    before = files(frames)
    result = openjd_run(openjd, tmp_path, gather_words(frames, frames, last=0))
    assert result.returncode != 0
    assert {name: data for name, data in files(frames).items() if not name.startswith(".parts")} == before


def test_parts_make_what_one_run_makes(parts, frames, tmp_path):
    """Also after an interruption: some files were moved, others were not."""
    out = tmp_path / "out"
    moved = [(parts / "0" / name) for name in ("frame.0000.exr", "holes/frame.0001.png")]
    whole = files(parts / "0")
    assert gather(parts, out, frames) == (2, 8, 0, (), (f"backend ref, version {VERSION}",))
    assert files(out) == files(tmp_path / "one")
    assert not parts.exists()
    for name, data in whole.items():
        (parts / "0" / name).parent.mkdir(parents=True, exist_ok=True)
        (parts / "0" / name).write_bytes(data)
    for path in moved:
        path.unlink()
    (parts / "0" / "notes.txt").write_text("mine")
    (parts / "mine").mkdir()
    plain(frames, parts / "1", (5, 7))
    gather(parts, out, frames)
    assert files(out) == files(tmp_path / "one")
    assert files(parts) == {"0/notes.txt": b"mine"}
    assert (parts / "mine").is_dir()


@pytest.mark.parametrize(
    ("missing_task", "tasks", "missing"),
    [
        ("1", [], ""),
        ("1", ["--frames", "0:7"], "missing: frames 5, 6, 7: in no part"),
        ("0", ["--frames", "0:7"], "missing: frames 0, 1, 2, 3, 4: in no part"),
        ("", ["--frames", "0:7"], ""),
    ],
)
def test_a_task_that_never_ran_is_named(parts, frames, tmp_path, missing_task, tasks, missing):
    if missing_task:
        shutil.move(parts / missing_task, tmp_path / "late")
    words = ("gather", parts, "-o", tmp_path / "out", "--sequence", frames, *tasks)
    result = call(*words)
    assert result.returncode == bool(missing)
    assert missing in result.stderr
    assert ("missing" in result.stderr) == bool(missing)
    if missing:  # the task runs again
        shutil.move(tmp_path / "late", parts / missing_task)
        assert call(*words).returncode == 0
        assert files(tmp_path / "out") == files(tmp_path / "one")


def test_gaps_are_named_without_a_range(frames, tmp_path):
    for name, numbers in (("0", (0, 1)), ("1", (6, 7))):
        plain(frames, tmp_path / "parts" / name, numbers)
    assert gather(tmp_path / "parts", tmp_path / "out", frames)[:4] == (2, 4, 4, (2, 3, 4, 5))


def test_a_gap_between_frames_is_never_walked(frames, tmp_path):
    plain(frames, tmp_path / "parts" / "0", (0, 1))
    report = gather(tmp_path / "parts", tmp_path / "out", frames, frames=(-(10**9) + 1, 10**9 - 1))
    assert report[1:3] == (2, 2 * 10**9 - 3)
    assert report.first_missing == tuple(range(-(10**9) + 1, -(10**9) + 9))


def write(path):
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"mine")


def linked(parts, out, frames):
    """A finished run behind a link among the parts."""
    (parts.parent / "one").rename(parts.parent / "finished")
    (parts / "2").symlink_to(parts.parent / "finished")


FAULTS = {  # change of parts, target and frames -> the message
    "damaged": (
        lambda parts, *_: write(parts / "1" / "frame.0006.exr"),
        "frame.0006.exr: not as its list says; make this part again",
    ),
    "parts differ": (
        lambda parts, _, frames: plain(frames, parts / "2", (7, 7), transfer="none"),
        "frame.0007.exr: another part has",
    ),
    "other settings": (
        lambda parts, _, frames: plain(frames, parts / "1", (5, 7), transfer="none", overwrite=True),
        "1/frame.0005.exr: transfer none, but .*0/frame.0000.exr has srgb; expected frames of one run",
    ),
    "another format": (
        lambda parts, _, frames: plain(frames, parts / "2", (7, 7), format="png"),
        "2/frame.0007.png: format png, but .*0/frame.0000.exr has exr; expected frames of one run",
    ),
    "another run": (
        lambda _, out, frames: plain(frames, out, transfer="none"),
        "frame.0000.exr: a part has another frame of this name",
    ),
    "a stranger's": (
        lambda _, out, frames: write(out / "frame.0003.exr"),
        "frame.0003.exr: not in stss.sha256, so not from an earlier",
    ),
    "the frames": (lambda _, out, frames: out.symlink_to(frames), "the folder of the frames that are read"),
    "a link": (linked, "2: expected the folder of a part, found a link"),
    "a frame without a list": (lambda parts, *_: write(parts / "2" / "frame.0000.exr"), "not in stss.sha256, so not from"),
    "among the parts": (lambda parts, out, _: out.symlink_to(parts / "all"), "out: expected a folder outside of"),
    "no parts": (lambda parts, *_: parts.rename(parts.with_name("gone")), "expected a folder with a folder for each part"),
}


def test_frames_of_two_devices_are_told(parts, frames, tmp_path, monkeypatch):
    """A farm may have several; unlike settings, that is no mistake."""
    monkeypatch.setattr(type(open_backend("ref", WEIGHTS)), "name", "another")
    plain(frames, parts / "1", (5, 7), overwrite=True)
    result = call("gather", parts, "-o", tmp_path / "out")
    assert result.returncode == 0
    assert re.search("made by: backend ref, version .*; backend another, version .*: the last bits", result.stderr)


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_not_gathered_is_told_and_stays(parts, frames, tmp_path, fault):
    becomes, words = FAULTS[fault]
    becomes(parts, tmp_path / "out", frames)
    before = files(tmp_path)
    with pytest.raises(InputError, match=words):
        gather(parts, tmp_path / "out", frames)
    # The list may be tidied.
    assert files(tmp_path) | {f"out/{SUMS}": b""} == before | {f"out/{SUMS}": b""}
    if fault == "another run":
        gather(parts, tmp_path / "out", frames, overwrite=True)
        assert files(tmp_path / "out") == files(tmp_path / "one")
