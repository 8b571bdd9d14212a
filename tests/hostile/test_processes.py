"""Processes: closed streams, little memory, an interrupt at any moment: one line or none, never a traceback."""

import os
import resource
import sys

import click
import pytest

from stss.demo import write_demo_sequence
from stss_ground.guard import run_guarded
from tests.hostile.cases import refused, stss


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    write_demo_sequence(out, 4, (18, 32))
    return out / "frames"


@pytest.mark.parametrize("mib", [400, 700])
def test_little_memory_is_one_line(frames, tmp_path, mib):
    def limit():
        resource.setrlimit(resource.RLIMIT_AS, (mib << 20, mib << 20))

    done = stss("run", frames, "-o", tmp_path / "out", "--weights", "bilinear", "--backend", "ref", preexec_fn=limit)
    assert "Traceback" not in done.stderr
    if done.returncode:
        refused(done, "out of memory")


@pytest.mark.parametrize("error", [MemoryError(), OSError(5, "Input/output error"), ImportError("failed to map segment from x")])
def test_what_a_system_refuses_is_one_line(monkeypatch, capsys, error):
    @click.command()
    def command():
        raise error

    monkeypatch.setattr(sys, "argv", ["stss"])
    monkeypatch.setattr(os, "dup2", lambda *_: None)
    monkeypatch.setattr(sys.stdout, "fileno", lambda: 1, raising=False)
    with pytest.raises(SystemExit) as ended:
        run_guarded(command)
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert said in ("stss: out of memory: the system gives this process no more\n", "stss: Input/output error\n")
