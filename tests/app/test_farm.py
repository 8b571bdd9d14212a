"""The job template for farms makes what one run makes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from stss.frames.backends import open_backend
from stss.run.job import run
from stss.run.options import RunOptions
from stss.sequence.reader import open_sequence
from stss.weights.file import BILINEAR, load

TEMPLATE = Path(__file__).parents[2] / "examples" / "farm" / "stss.openjd.yaml"


@pytest.fixture
def openjd():
    found = Path(sys.executable).with_name("openjd")
    if not found.exists():
        pytest.skip("no openjd-cli: pip install '.[test]'")
    return found


def test_the_template_is_one(openjd):
    done = subprocess.run([openjd, "check", TEMPLATE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_tasks_make_what_one_run_makes(openjd, write_frames, tmp_path):
    frames = write_frames(range(8), rendered={0, 2, 4, 6}, size=(8, 8))
    (tmp_path / "bin").mkdir()
    command = tmp_path / "bin" / "stss"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m stss "$@"\n')
    command.chmod(0o755)
    given = {"Frames": frames, "Out": tmp_path / "out", "Profile": "stss", "First": 0, "Last": 7, "Chunk": 5, "LastTask": 1}
    given["Options"] = "--backend ref --weights bilinear"
    words = [word for name, value in given.items() for word in ("-p", f"{name}={value}")]
    (tmp_path / "out").mkdir()
    environment = {**os.environ, "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    done = subprocess.run(
        [openjd, "run", TEMPLATE, "--step", "Gather", "--run-dependencies", *words],
        capture_output=True, text=True, env=environment, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr
    weights = load(BILINEAR)
    run(open_sequence(frames, "stss"), tmp_path / "one", open_backend("ref", weights.weights), weights.label, RunOptions())
    found, expected = (
        {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        for folder in (tmp_path / "out", tmp_path / "one")
    )
    assert found == expected
