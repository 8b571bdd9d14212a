"""The progress of a long command: a bar with the time left on a terminal, a line a minute in a log file."""

import io
import itertools
import re
import shutil
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
from click.testing import CliRunner
from rich.console import Console

from stss.cli import run
from stss.cli.main import stss as command
from stss_ground import progress
from stss_ground.errors import InputError
from stss_ground.progress import show_progress, show_steps
from stss_ground.terminal import Terminal
from stss_lab.bench import gpu_report
from stss_lab.stress import measure
from tests.app.conftest import PLAIN
from tests.hostile.cases import call


def lines_of(console):
    return console.file.getvalue().splitlines()


def wait_for(console, count):
    """Wait until this many lines are printed."""
    end = time.monotonic() + 20
    while len(lines_of(console)) < count:
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_log_file_gets_a_line_a_minute_even_while_nothing_is_done(monkeypatch):
    """The test makes the minutes; no two lines are equal, even in a step of many minutes."""
    seconds = itertools.count(0, 60)
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: next(seconds)))
    console = Console(file=io.StringIO(), width=20)
    with show_progress(console, 10, text="building kernels", every=0.01) as advance:
        wait_for(console, 3)
        advance("skipped 3%", done=4)
        wait_for(console, len(lines_of(console)) + 2)
    lines = lines_of(console)
    assert lines[:2] == ["0 of 10 frames in 0:01:00: building kernels", "0 of 10 frames in 0:02:00: building kernels"]
    assert re.fullmatch(r"4 of 10 frames in \d:\d\d:00, \d+\.\d\d frames/s, \d:\d\d:\d\d left: skipped 3%", lines[-1])
    assert len(set(lines)) == len(lines)
    time.sleep(0.05)
    assert lines_of(console) == lines


def test_a_log_in_colour_has_no_bar(monkeypatch):
    """FORCE_COLOR, which services for CI set: a bar is drawn ten times a second, and a log keeps all of them."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.delenv("COLUMNS", raising=False)
    console = Terminal(file=io.StringIO())
    with show_progress(console, 10) as advance:
        advance(done=10)
    console.print("[red]x[/]" + 150 * "y")
    assert re.fullmatch(r"\x1b\[31mx\x1b\[0my{150}\n", console.file.getvalue())


def test_a_log_file_says_soon_what_a_command_waits_for(monkeypatch):
    monkeypatch.setattr(progress, "TEN_SECONDS", 0.01)
    console = Console(file=io.StringIO(), width=20)
    with show_progress(console, 10, text="building kernels", every=3600):
        wait_for(console, 1)
        time.sleep(0.05)
    assert lines_of(console) == ["0 of 10 frames in 0:00:00: building kernels"]


def test_a_log_file_has_a_line_after_ten_seconds_and_then_each_minute(monkeypatch):
    """The waits themselves: a test that waits takes a minute."""
    waits = []

    class Ended:
        def wait(self, seconds):
            waits.append(seconds)
            return len(waits) > 2

        def set(self):
            """Nothing: three waits end it."""

    monkeypatch.setattr(progress, "Event", Ended)
    with show_progress(Console(file=io.StringIO()), 10):
        pass
    assert waits == [10, 60, 60]


def test_a_step_is_done_when_the_next_begins():
    console = Console(file=io.StringIO(), force_terminal=True, width=120)
    with show_steps(console, 2) as begin:
        begin("one")
        begin("two")
    assert re.search(r"2/2", console.file.getvalue())


@pytest.fixture(scope="module")
def folder(demo, tmp_path_factory):
    """A demo sequence, what was made of it, and of it in two parts."""
    folder = shutil.copytree(demo, tmp_path_factory.mktemp("progress"), dirs_exist_ok=True)
    for out, numbers in (("out", "0:3"), ("parts/0", "0:1"), ("parts/1", "2:3")):
        assert not call("run", folder / "frames", "-o", folder / out, *PLAIN, "--frames", numbers).returncode
    return folder


@pytest.mark.parametrize(
    "command",
    [
        "check frames",
        "run frames -o new --weights bilinear --backend ref",
        "gather parts -o whole",
        "compare out truth --html page.html",
        "methods frames truth -o methods --methods bilinear --html m.html",
        "bench --size 16x8 --repeat 1 --ours ref --peers ,",
        "stress --backend ref --only positions",
        "gpu-report -o report --tiny",
    ],
)
def test_every_long_command_has_a_bar_with_the_time_left(folder, tmp_path, monkeypatch, command):
    """`stss tune`, `demo` and `conform` have their own tests of progress."""
    make_plan = measure.make_plan
    monkeypatch.setattr(
        measure, "make_plan", lambda *options: replace(make_plan(*options), seeds=1, size=(16, 24), sizes=(8, 16))
    )
    for name in ("frames", "truth", "out", "parts"):
        shutil.copytree(folder / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FORCE_COLOR", "1")
    always = property(lambda self: True, lambda self, value: None)
    monkeypatch.setattr(Terminal, "is_interactive", always, raising=False)
    monkeypatch.setattr(gpu_report, "steps", lambda *_, **__: [gpu_report.Step("absent", None, 0, "not here")])
    process = call(*command.split())
    assert process.returncode in (0, 1), process.stderr
    assert re.search(r"\D([1-9]\d*)/\1\D.* left", process.stderr)


@pytest.mark.parametrize(
    ("more", "words"), [([], "building kernels"), (["--cluster", "tcp://127.0.0.1:1"], "waiting for workers")]
)
def test_what_a_run_waits_for(tmp_path, write_frames, monkeypatch, more, words):
    """A scheduler that does not answer builds no kernels."""

    def stop(console, total, text):
        raise InputError(text)

    monkeypatch.setattr(run, "show_progress", stop)
    result = CliRunner().invoke(command, ["run", str(write_frames([0, 1])), "-o", str(tmp_path / "out"), *PLAIN, *more])
    assert words in str(result.exception) + result.output
