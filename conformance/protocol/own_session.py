# SPDX-License-Identifier: MIT
"""Run an unknown program in a session of its own: its time and its output are limited, and its processes end with it.

On Linux these are all that it started (`reaper`). Elsewhere they are its process group, which ``setsid`` leaves.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Any, BinaryIO, cast

from stss_ground.terminal import printable

TAIL_BYTES = 2000
"""Bytes of the end of stderr that are shown."""
MOST_SAID = 64 * 2**20
"""Most bytes of stdout, and of stderr: a program that writes more is stopped."""
ON_LINUX = sys.platform == "linux"
REAPER = (sys.executable, "-I", "-S", Path(__file__).with_name("reaper.py"))
GRACE = 10.0
"""Seconds that the reaper has to end the rest."""
LOOK = 0.1
"""Seconds between two checks of the time and of the output's size; a program that ends is seen at once."""


@dataclass(frozen=True)
class Ending:
    """How a program ended.

    Attributes:
        status: its exit status, negative for a signal; None: it was stopped.
        has_talked: whether it was stopped for writing too much.
        stderr: the end of its stderr, without control characters.
    """

    status: int | None
    has_talked: bool
    stderr: str


def run_alone(
    command: Sequence[str],
    out: BinaryIO,
    err: BinaryIO,
    timeout: float,
    *,
    folder: Path | None = None,
    env: Mapping[str, str] | None = None,
) -> Ending:
    """Run a program to its end, or stop it; then stop all that it started.

    Args:
        command: program and arguments.
        out: file for stdout, open for reading as well.
        err: file for stderr, likewise.
        timeout: seconds.
        folder: where it runs; None: in this process's.
        env: its environment; None: this process's.

    Raises:
        OSError: it cannot be started.
    """
    session = Session(command, stdin=subprocess.DEVNULL, stdout=out, stderr=err, cwd=folder, env=env)
    process = session.process
    ended, reasons, end = Event(), list[str](), time.monotonic() + timeout

    def watch() -> None:
        while not ended.wait(LOOK):
            if max(os.fstat(file.fileno()).st_size for file in (out, err)) > MOST_SAID:
                reasons.append("output")
            elif time.monotonic() > end:
                reasons.append("time")
            if reasons:
                stop(process)
                return

    watcher = Thread(target=watch, daemon=True)
    watcher.start()
    try:
        process.wait()
    finally:
        ended.set()
        watcher.join()
        report = session.close()
    return Ending(None if reasons else session.status(report), "output" in reasons, tail(err))


class Session:
    """A program that has been started in a session of its own; ``options`` are those of ``subprocess.Popen``."""

    def __init__(self, command: Sequence[str], **options: Any):
        self._program = command[0]
        self._reading, writing = os.pipe() if ON_LINUX else (None, None)
        try:
            whole = [*REAPER, str(writing), *command] if ON_LINUX else command
            fds = () if writing is None else (writing,)
            started = subprocess.Popen(whole, start_new_session=True, pass_fds=fds, **options)
            self.process = cast("subprocess.Popen[bytes]", started)
        finally:
            if writing is not None:
                os.close(writing)

    def close(self) -> bytes:
        """Stop the rest of it; returns its reaper's report, at the first time."""
        stop(self.process)
        report = b""
        if self._reading is not None:
            report = os.read(self._reading, 64)
            os.close(self._reading)
        self._reading = None
        return report

    def status(self, report: bytes) -> int:
        """Its exit status, negative for a signal; OSError if it could not be started."""
        return status_of(report, self._program) if ON_LINUX else self.process.returncode


def status_of(report: bytes, program: str | Path) -> int:
    """The status of a program as its reaper reports it; without a report the reaper was killed, and the program with it."""
    kind, _, number = report.partition(b" ")
    if kind == b"errno":
        raise OSError(int(number), os.strerror(int(number)), str(program))
    return int(number) if kind == b"status" else -signal.SIGKILL


def stop(process: subprocess.Popen[bytes]) -> None:
    """End a program with all processes of it that can be reached."""
    if ON_LINUX:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(GRACE)
            return
    if os.name != "posix":
        process.kill()
    else:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def describe(status: int) -> str:
    """A status in words."""
    if status >= 0:
        return f"ended with status {status}"
    try:
        return f"ended by {signal.Signals(-status).name}"
    except ValueError:
        return f"ended by signal {-status}"


def tail(file: BinaryIO) -> str:
    """The end of a file's text, without control characters."""
    file.seek(0, os.SEEK_END)
    file.seek(max(0, file.tell() - TAIL_BYTES))
    text = file.read(TAIL_BYTES).decode(errors="replace").strip()
    return "\n".join(map(printable, text.splitlines()))
