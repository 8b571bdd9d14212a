# SPDX-License-Identifier: MIT
"""A program that is started once, as ``PROGRAM --serve``, and computes job after job: docs/ports.md."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from tempfile import TemporaryFile
from threading import Thread

from conformance.protocol.job_folder import JobError
from conformance.protocol.own_session import GRACE, LOOK, MOST_SAID, Session, describe, tail

SERVE = "--serve"
READY = "stss serve 1"
"""The line that a program says first; 1 is the version of the protocol."""
END = "done "
"""Prefix of the line that names a computed job folder."""
READY_SECONDS = 10.0
"""Most time until a program says that it serves; devices may be opened later."""
MOST_LINE = 1 << 16


class OutOfTimeError(JobError):
    """A program has not ended its job within ``timeout`` seconds."""

    def __init__(self, timeout: float):
        super().__init__(f"stopped after {timeout:g} s")


class TooMuchError(JobError):
    """A program has written too much to its output."""

    def __init__(self) -> None:
        super().__init__(f"stopped: more than {MOST_SAID >> 20} MiB on its output")


class Server:
    """A program that serves; close it at the end.

    Args:
        command: program and arguments, without ``--serve``.

    Attributes:
        stderr: the end of its stderr during its last job.
    """

    def __init__(self, command: Sequence[str]):
        # To append: the program writes at the end, wherever this process reads.
        self._err = TemporaryFile("a+b", buffering=0)  # noqa: SIM115
        self._session = Session([*command, SERVE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._err)
        self._process = self._session.process
        self._lines: SimpleQueue[str | None] = SimpleQueue()
        self._output_bytes = 0
        self.stderr = ""
        self._listener = Thread(target=self._listen, daemon=True)
        self._listener.start()

    def is_ready(self, timeout: float) -> bool:
        """Whether it says that it serves; any other program ends, or says something else."""
        end = time.monotonic() + min(timeout, READY_SECONDS)
        while time.monotonic() < end and not self._too_much():
            try:
                return self._lines.get(timeout=LOOK) == READY
            except Empty:
                continue
        return False

    def run(self, job: Path, timeout: float) -> None:
        """Hand over a job, and wait until it is computed; the program is stopped if it is not.

        Raises:
            JobError: it ends, takes or says too much, or answers for another job.
        """
        self._output_bytes = 0
        self._err.seek(0)
        self._err.truncate()
        try:
            self._exchange(job, timeout)
        except JobError:
            self._session.close()  # first: on Windows both have one position in the file
            self._keep_stderr(job)
            self.close()
            raise
        self._keep_stderr(job)

    def close(self) -> None:
        """Stop it, with all that it started."""
        self._session.close()
        self._listener.join(GRACE)
        for file in filter(None, (self._process.stdin, self._process.stdout, self._err)):
            with suppress(OSError):
                file.close()

    def _keep_stderr(self, job: Path) -> None:
        self._err.seek(0)
        with suppress(FileNotFoundError):  # where it removed its job
            (job / "stderr.txt").write_bytes(self._err.read(MOST_SAID))
        self.stderr = tail(self._err)

    def _exchange(self, job: Path, timeout: float) -> None:
        """Hand over a job and wait for its line; JobError if it does not come."""
        assert self._process.stdin is not None
        end = time.monotonic() + timeout
        path = os.fsencode(job)
        answer = f"{END}{path.decode(errors='replace')}"
        try:
            self._process.stdin.write(path + b"\n")
            self._process.stdin.flush()
        except OSError:
            raise JobError(self._ending()) from None
        while True:
            try:
                line = self._lines.get(timeout=LOOK)
            except Empty:
                line = ""
            if line is None:
                raise JobError(self._ending())
            if line == answer:
                return
            if line.startswith(END):
                raise JobError(f"answered for another job: expected {job}, got {line[len(END) :][:200]}")
            if self._too_much():
                raise TooMuchError
            if time.monotonic() > end:
                raise OutOfTimeError(timeout)

    def _ending(self) -> str:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE)
        return f"{describe(self._session.status(self._session.close()))} while it served"

    def _too_much(self) -> bool:
        return max(self._output_bytes, os.fstat(self._err.fileno()).st_size) > MOST_SAID

    def _listen(self) -> None:
        """Read its lines; those longer than ``MOST_LINE`` are no answers."""
        assert self._process.stdout is not None
        rest = b""
        while some := os.read(self._process.stdout.fileno(), MOST_LINE):
            self._output_bytes += len(some)
            *lines, rest = (rest + some).split(b"\n")
            for line in lines:
                self._lines.put(line.decode(errors="replace").rstrip("\r"))
            rest = rest[-MOST_LINE:]
        self._lines.put(None)
