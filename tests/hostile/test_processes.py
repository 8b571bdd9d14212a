"""Processes: closed streams, little memory, an interrupt at any moment: one line or none, never a traceback."""

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import pytest

from stss.__main__ import main
from stss.images.read_write import write_rgb
from stss.run.job import run
from stss.run.options import RunOptions
from stss.sequence.reader import open_sequence
from stss_ground.exit_status import run_guarded
from stss_lab.baselines.registry import MethodBackend
from tests.hostile.cases import call, stss


@pytest.fixture(autouse=True)
def own_interrupt():
    """``main`` gives up the handler of Ctrl-C at its end; other tests need it, and so do their child processes."""
    handler = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, handler)


@pytest.fixture
def frames(demo):
    return demo / "frames"


def test_a_closed_stream_is_no_file(frames, tmp_path):
    """Text for a closed stream does not get into the next opened file, and the status is the run's."""
    out = tmp_path / "out"
    words = f"{sys.executable} -m stss run {frames} -o {out} --weights bilinear --backend ref"
    assert subprocess.run(["sh", "-c", f"{words} <&- >&- 2>&-"], check=False).returncode == 0
    assert call("run", frames, "-o", out, "--weights", "bilinear", "--backend", "ref", "--resume").stderr.count("4 kept") == 1
    process = subprocess.run(["sh", "-c", f"{words} 2>&-"], stdout=subprocess.PIPE, text=True, check=False)
    assert (process.returncode, process.stdout) == (2, "")


def test_a_terminal_of_no_columns_loses_no_line(frames, tmp_path):
    """COLUMNS=0, as some containers and editors set it."""
    process = stss("run", frames, "-o", tmp_path / "out", "--weights", "bilinear", "--backend", "ref", env={"COLUMNS": "0"})
    assert "2 SF, 2 EF written" in process.stderr


def test_a_current_folder_that_was_removed_is_said(frames, tmp_path):
    (tmp_path / "here").mkdir()
    words = f"cd here && rmdir ../here && {sys.executable} -m stss run {frames} -o {tmp_path / 'out'} --weights bilinear"
    environment = {**os.environ, "PYTHONPATH": str(Path.cwd())}
    process = subprocess.run(["sh", "-c", words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (process.returncode, process.stderr) == (2, "stss: the current folder was removed; change to another one\n")


def test_little_memory_is_one_line(frames, tmp_path):
    """Beside what OpenEXR's own library prints where memory ends within it."""

    def limit():
        resource.setrlimit(resource.RLIMIT_AS, (500 << 20, 500 << 20))

    process = stss("run", frames, "-o", tmp_path / "out", "--weights", "bilinear", "--backend", "ref", preexec_fn=limit)
    assert "Traceback" not in process.stderr
    assert process.returncode in (0, 2)
    assert process.stderr.splitlines()[-1].startswith("stss: ") == (process.returncode == 2)


@pytest.mark.parametrize("error", [MemoryError(), OSError(5, "Input/output error"), ImportError("failed to map segment from x")])
def test_what_a_system_refuses_is_one_line(monkeypatch, capsys, error):
    @click.command()
    def command():
        raise error

    monkeypatch.setattr(sys, "argv", ["stss"])
    monkeypatch.setattr(os, "dup2", lambda *_: None)
    monkeypatch.setattr(sys.stdout, "fileno", lambda: 1, raising=False)
    with pytest.raises(SystemExit) as exit_error:
        run_guarded(command)
    text = capsys.readouterr().err
    assert exit_error.value.code == 2
    assert text in ("stss: out of memory: the system gives this process no more\n", "stss: Input/output error\n")


@pytest.mark.skipif(os.name == "nt", reason="no signals")
def test_an_interrupt_while_it_starts_says_nothing(tmp_path):
    """As soon as the program begins to import its commands, and a little later."""
    program = """
import sys
from stss.__main__ import main

def say(event, arguments):
    if event == "import" and arguments[0] == "stss.cli.main":
        print(flush=True)

sys.addaudithook(say)
sys.argv = ["stss", "--help"]
main()
"""
    for delay in (0.0, 0.2, 0.5):
        with subprocess.Popen(
            [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            process.stdout.readline()
            time.sleep(0.05 + delay)
            process.send_signal(signal.SIGINT)
            _, text = process.communicate(timeout=60)
        # The last: as it ends, when Python has given its handler back.
        assert process.returncode in (0, 130, -signal.SIGINT)
        assert not text.strip()


def test_a_second_interrupt_while_it_ends_says_nothing():
    """What is to be done at the end, as the files of new kernels are remembered, is not broken off."""
    program = """
import atexit, signal, sys
import stss.cli.main
from stss.__main__ import main

def command():
    signal.raise_signal(signal.SIGINT)

def end():
    print("ends", flush=True)
    print(sys.stdin.readline(), end="", flush=True)

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
atexit.register(end)
stss.cli.main.main = command
main()
"""
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen([sys.executable, "-c", program], **pipes, text=True) as process:
        assert process.stdout.readline() == "ends\n"
        process.send_signal(signal.SIGINT)
        out, text = process.communicate("ended\n", timeout=60)
    assert (process.returncode, out, text) == (130, "ended\n", "")


def test_the_signal_of_podman_stop_ends_the_first_process_of_a_container(frames, tmp_path):
    """The first process of a namespace ignores signals without a handler, SIGTERM too; after ten seconds it would be killed."""
    (name,) = re.findall(r"^STOPSIGNAL (\w+)$", Path("packaging/Containerfile").read_text(), re.MULTILINE)
    alone = ("unshare", "--pid", "--fork", "--kill-child")
    if not shutil.which("unshare") or subprocess.run([*alone, "true"], check=False, capture_output=True).returncode:
        pytest.skip("no namespace of processes: unshare is not there, or not allowed")
    program = """
import signal, time
from stss.cli.main import main
from stss.frames.backends import ReferenceBackend
ReferenceBackend.compute = lambda *_: time.sleep(60)
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
main()
"""
    words = [*alone, sys.executable, "-c", program, "run", frames, "-o", tmp_path / "out", "--backend", "ref"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr.readline().startswith("profile: ")
        first = int(Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text())
        os.kill(first, getattr(signal, name))
        process.communicate(timeout=60)
    assert process.returncode == 130


def test_an_interrupt_of_a_command_says_nothing(monkeypatch, capsys, tmp_path):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("stss.check_sequence.report.check", interrupted)
    monkeypatch.setattr(sys, "argv", ["stss", "check", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130
    assert capsys.readouterr().err == ""


def test_frames_and_list_that_were_edited_by_hand_are_made_again(frames, tmp_path):
    """The file has the checksum of the list, and neither key nor kind; another is no image."""
    sequence, out = open_sequence(frames, "stss"), tmp_path / "out"

    def again():
        return run(sequence, out, MethodBackend("bilinear"), "none", RunOptions(resume=True)).count("done")

    assert again() == 4
    write_rgb(out / "frame.0001.exr", [[[0.0, 0.0, 0.0]]])
    (out / "frame.0002.exr").write_text("no image")
    sums = subprocess.run(["sha256sum", "frame.0001.exr", "frame.0002.exr"], cwd=out, capture_output=True, text=True, check=True)
    with (out / "stss.sha256").open("a") as file:
        file.write(sums.stdout)
    assert again() == 2
    assert again() == 0
