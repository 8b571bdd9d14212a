"""``stss`` as a user types it, in this process or in another, and the form of a refusal."""

import contextlib
import io
import os
import signal
import subprocess
import sys
import warnings
from pathlib import Path

from stss.cli.main import main


def stss(*arguments, cwd=None, env=None, timeout=120, **more):
    """Run ``stss`` in a process of its own; ``env`` is added to the environment."""
    command = [sys.executable, "-m", "stss", *map(_text, arguments)]
    environment = {**os.environ, **(env or {})}
    return subprocess.run(
        command, capture_output=True, text=True, errors="replace", timeout=timeout, cwd=cwd, env=environment, check=False, **more
    )


def call(*arguments, seconds=60):
    """Call ``stss`` in this process, with a limit of its time (not on Windows); warnings are errors. Most of a process's time is its
    start."""
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8") for _ in range(2))
    argv, status = sys.argv, 0
    if hasattr(signal, "alarm"):
        signal.signal(signal.SIGALRM, _hangs)
        signal.alarm(seconds)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            warnings.simplefilter("error")
            sys.argv = ["stss", *map(os.fsdecode, map(_text, arguments))]
            main()
    except SystemExit as ended:
        status = ended.code
    finally:
        if hasattr(signal, "alarm"):
            signal.alarm(0)
        sys.argv = argv
    out.flush(), err.flush()
    texts = (stream.buffer.getvalue().decode() for stream in (out, err))
    return subprocess.CompletedProcess(arguments, status, *texts)


class HangError(BaseException):
    """A call takes too long. No ``Exception``, since the called code must not catch it."""


def _hangs(*_):
    raise HangError("no end in time")


NOTES = ("first start: ", "weights: ", "profile: ", "camera: ", "views: ", "background: ", "png: ")
"""Lines of a command besides its error."""


def refused(result, *words):
    """One line on stderr that holds all of ``words``, status 2, no traceback, nothing unprintable."""
    assert result.returncode == 2, result.stderr
    lines = [line for line in result.stderr.strip().splitlines() if not line.startswith(NOTES)]
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("stss: ")
    assert lines[0].isprintable(), lines[0]
    for word in words:
        assert str(word) in lines[0], lines[0]


def _text(argument):
    return argument if isinstance(argument, (str, bytes, os.PathLike)) else str(argument)


def runs(pid):
    """Whether a process exists, and is not just a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


NOBODY = 65534


@contextlib.contextmanager
def unprivileged():
    """Take root's privileges from this process for a while."""
    root = os.geteuid() == 0
    if root:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)
