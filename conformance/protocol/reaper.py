# SPDX-License-Identifier: MIT
"""A separate program, on Linux: it starts another program and adopts the processes that this leaves, so that none of them survives.

``python reaper.py FD PROGRAM ARGUMENT ...`` writes ``status N`` (negative for a signal) or ``errno N`` to the file descriptor. It ends
them on SIGTERM, and when the process that started it ends.
"""

import ctypes
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
SIGNALS = [signal.SIGPIPE, signal.SIGXFSZ]
"""Signals that Python ignores, while programs expect the default."""


class StoppedError(Exception):
    """SIGTERM came."""


def main() -> None:
    """Run the program to its end, then end its other processes."""
    report, command = int(sys.argv[1]), sys.argv[2:]
    os.set_inheritable(report, False)
    signal.signal(signal.SIGTERM, _stop)
    control = ctypes.CDLL(None).prctl
    control(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    control(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    with suppress(StoppedError):
        try:
            program = os.posix_spawnp(command[0], command, os.environ, setsid=True, setsigdef=SIGNALS)
            _, status = os.waitpid(program, 0)
            os.write(report, b"status %d" % os.waitstatus_to_exitcode(status))
        except OSError as error:
            os.write(report, b"errno %d" % (error.errno or 0))
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            end_all()


def _stop(*_: object) -> None:
    raise StoppedError


def end_all() -> None:
    """Kill all children, and their children, which become ours when their parents end."""
    while sum(kill(child) for child in children()):
        os.wait()


def kill(child: int) -> bool:
    """Send SIGKILL to a process. False: it has ended, or is another user's."""
    try:
        os.kill(child, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        return False
    return True


def children() -> list[int]:
    """The child processes of this one, including ended ones that were not waited for."""
    numbers = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            # The name before the last parenthesis may hold anything; then come state and parent.
            if int(path.read_text(errors="replace").rpartition(")")[2].split()[1]) == os.getpid():
                numbers.append(int(path.parent.name))
    return numbers


if __name__ == "__main__":
    main()
