# SPDX-License-Identifier: MIT
"""A program that computes jobs (spec 11): it is started for each, or serves. Breaches of the protocol are found here."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from conformance.protocol.job_folder import JobError, require_real, require_unchanged, stamps_of_inputs
from conformance.protocol.own_session import Ending, describe, run_alone
from conformance.protocol.port import Case, PortError
from conformance.protocol.served import OutOfTimeError, Server, TooMuchError

T = TypeVar("T")
MEMORY = Path("/dev/shm")
ANYWHERE = "stss job " if os.name == "nt" else os.fsdecode("stss job \u00e9 ".encode())
"""Beginning of the name of a judge's job folder: a user's folder for temporary files may have such letters. On Windows a program's
arguments come in a code page, which may lack them."""
ROOM, LEAST_ROOM = 4, 512 * 2**20
"""Free memory for a job in memory: a multiple of its inputs, and at least this number of bytes."""


class NotStartedError(PortError):
    """There is no such program, or it may not be executed."""


class Program:
    """A program, called with job folders.

    A job folder is removed after success. After a failure it is kept, with ``stderr.txt`` and ``stdout.txt`` in it, and the error
    names it; of many failures only the last one's is there.

    Attributes:
        name: the program's name, without its folder.
        stderr: the end of the stderr of the program's last run.
        kept_job: the job folder of its last run that failed, if any.
    """

    def __init__(self, command: Sequence[str], timeout: float, *, keep: bool = True):
        """Make a port of a command.

        Args:
            command: program and arguments; the job folder is added as the last one.
            timeout: seconds for one job, whatever the number of cases.
            keep: keep the job of a failure; not where the caller keeps its case, as the judge does.
        """
        self.name = Path(command[0]).name
        self.stderr = ""
        self.kept_job: Path | None = None
        self._command = list(command)
        self._timeout = timeout
        self._keep = keep
        self._server: Server | None = None
        self._serves = True
        atexit.register(self.restart)

    def restart(self) -> None:
        """Forget the program's state: the next job is computed by a new process."""
        if self._server is not None:
            self._server.close()
        self._server = None

    def compute(self, cases: Sequence[Case], write: Callable[[Path], None], read: Callable[[Path, int], T]) -> list[T]:
        """Let the program compute a job.

        Args:
            cases: of the job.
            write: writes them into its folder.
            read: reads the folder of the case of this number.

        Raises:
            PortError: the program is not there, fails, takes or says too much, changes its inputs, or ``read`` raises JobError.
        """
        job = Path(tempfile.mkdtemp(prefix="stss-job-" if self._keep else ANYWHERE, dir=place_for(cases)))
        results: list[T] = []
        ran = False
        try:
            write(job)
            stamps = stamps_of_inputs(job, len(cases))
            self._start(job)
            ran = True
            require_real(job)
            require_unchanged(stamps, stamps_of_inputs(job, len(cases)))
            for number in range(len(cases)):
                results.append(read(job / f"{number:04d}", number))
        except JobError as error:
            at = len(results) if ran else _first_unanswered(job, len(cases))
            late = isinstance(error, OutOfTimeError)
            message = f"{self.name}: {self._put_away(job, str(error))}"
            raise PortError(message, at, late=late, silent=late and at == 0) from error
        except BaseException:
            shutil.rmtree(job, ignore_errors=True)
            raise
        shutil.rmtree(job, ignore_errors=True)
        return results

    def _start(self, job: Path) -> None:
        """Let the program compute ``job``: a serving one goes on, any other runs to its end."""
        try:
            server = self._serving()
        except OSError as error:
            raise NotStartedError(f"{self._command[0]}: cannot be started: {error.strerror or error}") from error
        if server is not None:
            try:
                server.run(job, self._timeout)
            except JobError:
                self._server = None
                raise
            finally:
                self.stderr = server.stderr
            return
        with (job / "stdout.txt").open("w+b") as out, (job / "stderr.txt").open("w+b") as err:
            try:
                ending = run_alone([*self._command, str(job)], out, err, self._timeout)
            except OSError as error:
                raise NotStartedError(f"{self._command[0]}: cannot be started: {error.strerror or error}") from error
            self.stderr = ending.stderr
        _require_end(ending, self._timeout)

    def _serving(self) -> Server | None:
        """The program, if it serves; asked once."""
        if self._server is None and self._serves:
            server = Server(self._command)
            if server.is_ready(self._timeout):
                self._server = server
            else:
                server.close()
                self._serves = False
        return self._server

    def _put_away(self, job: Path, words: str) -> str:
        """Keep or remove the job of a failure; gives its ``words``, and the program's, with the place where the job is now."""
        place = ""
        if self._keep and job.is_dir():
            if self.kept_job is not None:
                shutil.rmtree(self.kept_job, ignore_errors=True)
            in_memory = job.parent == MEMORY  # which is not for files that stay
            self.kept_job = Path(shutil.move(job, tempfile.gettempdir())) if in_memory else job
            place = f"{self.kept_job}{os.sep}"
            words += f"; its job is kept: {self.kept_job}"
        else:
            shutil.rmtree(job, ignore_errors=True)
        last_words = f"\n{self.stderr}" if self.stderr else ""
        return f"{words}{last_words}".replace(f"{job}{os.sep}", place)


def place_for(cases: Sequence[Case]) -> Path | None:
    """The folder for a job: in memory where the system has a folder there with room, and ``TMPDIR`` names no other.

    Thousands of small files take longer on a disk than their numbers to compute. None: the usual place.
    """
    size = ROOM * sum(array.nbytes for case in cases for array in case.inputs.values()) + LEAST_ROOM
    usual = tempfile.gettempdir() == "/tmp"
    try:
        return MEMORY if usual and os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free > size else None
    except OSError:
        return None


def _first_unanswered(job: Path, count: int) -> int | None:
    """Number of the first case of a job that a program has not begun to answer: usually the case at which it failed."""
    names = (f"{number:04d}" for number in range(count))
    return next(
        (n for n, name in enumerate(names) if not any((job / name / file).exists() for file in ("out", "unsupported"))), None
    )


def _require_end(ending: Ending, timeout: float) -> None:
    """Raise JobError, a reason to reject all of the program's outputs, unless it ended well."""
    if ending.status is None:
        raise TooMuchError if ending.has_talked else OutOfTimeError(timeout)
    if ending.status != 0:
        raise JobError(describe(ending.status))
