# SPDX-License-Identifier: MIT
"""Run an unknown program in a session of its own: none of its processes outlives it, and its output is limited."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from conformance.protocol.job_tree import printable

TAIL_BYTES = 2000
"""Bytes of the end of stderr that are shown."""
MOST_SAID = 64 * 2**20
"""Most bytes of stdout, and of stderr: a program that writes more is stopped."""
GRACE = 1.0
"""Seconds in which a program's own child processes may end after it."""
_LOOK = 0.1
"""Seconds between two checks of the size of its output."""


@dataclass(frozen=True)
class Ending:
    """How a program ended.

    Attributes:
        status: its exit status, negative for a signal; None: it was stopped.
        talked: whether it was stopped for writing too much.
        left_behind: number of processes of its session that still ran after it; they were stopped.
        stderr: the end of its stderr, without control characters.
    """

    status: int | None
    talked: bool
    left_behind: int
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
    """Run a program to its end, or stop it; then stop all processes that it has left behind.

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
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=out, stderr=err, cwd=folder, env=env, start_new_session=True
    )
    status, talked = None, False
    end = time.monotonic() + timeout
    try:
        while status is None and not talked and (left := end - time.monotonic()) > 0:
            status = _waited(process, min(left, _LOOK))
            talked = max(os.fstat(file.fileno()).st_size for file in (out, err)) > MOST_SAID
        left_behind = _left(process.pid, GRACE) if status is not None else 0
    finally:
        _stop(process)
    return Ending(None if talked else status, talked, left_behind, _tail(err))


def _waited(process: subprocess.Popen[bytes], seconds: float) -> int | None:
    """Its status as soon as it has one; None: it still runs. ``Popen.wait`` looks every 50 ms only."""
    with suppress(OSError, AttributeError):
        handle = os.pidfd_open(process.pid)
        try:
            ended = select.poll()
            ended.register(handle, select.POLLIN)
            ended.poll(seconds * 1000)
            return process.poll()
        finally:
            os.close(handle)
    with suppress(subprocess.TimeoutExpired):
        return process.wait(seconds)
    return None


def _left(leader: int, grace: float) -> int:
    """How many of an ended leader's session still run when the grace is over."""
    end = time.monotonic() + grace
    while (count := len(_running(leader))) and time.monotonic() < end:
        time.sleep(0.01)
    return count


def _stop(process: subprocess.Popen[bytes]) -> None:
    """End the program, if it still runs, with what it has started itself."""
    if os.name != "posix":
        process.kill()
        process.wait()
        return
    if process.poll() is None:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    end = time.monotonic() + GRACE
    while (running := _running(process.pid)) and time.monotonic() < end:
        for pid in running:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.001)


def _running(leader: int) -> list[int]:
    """Processes of a session, but for those that have ended and are only waited for."""
    found: list[int] = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError):
            # The name, in parentheses, may hold anything.
            state, _, group, session = stat.read_text(errors="replace").rpartition(")")[2].split()[:4]
            if leader in (int(group), int(session)) and state not in "ZX":
                found.append(int(stat.parent.name))
    return found or _group(leader)


def _group(leader: int) -> list[int]:
    """The same where there is no ``/proc``: the whole group, as `os.kill` takes it."""
    if os.name != "posix" or Path("/proc/self/stat").exists():
        return []
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(leader, 0)
        return [-leader]
    return []


def described(status: int) -> str:
    """A status in words."""
    if status >= 0:
        return f"ended with status {status}"
    try:
        return f"ended by {signal.Signals(-status).name}"
    except ValueError:
        return f"ended by signal {-status}"


def _tail(file: BinaryIO) -> str:
    file.seek(0, os.SEEK_END)
    file.seek(max(0, file.tell() - TAIL_BYTES))
    text = file.read(TAIL_BYTES).decode(errors="replace").strip()
    return "\n".join(map(printable, text.splitlines()))
