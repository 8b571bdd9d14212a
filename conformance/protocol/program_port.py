# SPDX-License-Identifier: MIT
"""A port that is a program: it is called with a job folder and leaves its outputs there (spec 11)."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from conformance.protocol.job_folder import (
    DTYPE,
    JobError,
    read_layers,
    read_outputs,
    require_real,
    require_unchanged,
    stamps_of_inputs,
    write_job,
)
from conformance.protocol.own_session import MOST_SAID, Ending, describe, run_alone
from conformance.protocol.port import Arrays, Case, Outputs, PortError, Unsupported
from conformance.protocol.served import Server
from conformance.protocol.stages import STAGES, check_inputs
from stss_ref.weights import Weights, zeros

T = TypeVar("T")
MEMORY = Path("/dev/shm")
ROOM, LEAST_ROOM = 4, 512 * 2**20
"""Free memory that a job needs to lie in memory: as a multiple of its inputs, and at least this number of bytes."""
PROBED = ((8, 8), (72, 136))
"""(H, W) at which a program is asked for its stages."""


class FolderPort:
    """Runs a program on job folders, with many cases at one start.

    A job folder is removed after success. After a failure it is kept, with ``stderr.txt`` and ``stdout.txt`` in it, and the error
    names it.

    Attributes:
        name: the program's name, without its folder.
        dtype: the program's arithmetic; the files are float32 in any case.
        stderr: the end of the stderr of the program's last run.
        kept: the job folder of its last run that failed, if any.
    """

    def __init__(self, command: Sequence[str], timeout: float, dtype: str = DTYPE, stages: Iterable[str] = STAGES):
        """Make a port of a command.

        Args:
            command: program and arguments; the job folder is added as the last one.
            timeout: seconds for one start, whatever the number of cases.
            dtype: ``float32`` or ``float16``.
            stages: those that it is asked for: all others count as lacking.
        """
        self._asked_for = [stage for stage in STAGES if stage in set(stages)]
        self.name = Path(command[0]).name
        self.dtype = dtype
        self.stderr = ""
        self.kept: Path | None = None
        self._command = list(command)
        self._timeout = timeout
        self._stages: frozenset[str] | None = None
        self._server: Server | None = None
        self._serves = True
        atexit.register(self.restart)

    def restart(self) -> None:
        """Forget what the program may remember: the next job is computed by a new process."""
        if self._server is not None:
            self._server.close()
        self._server = None

    def stages(self) -> frozenset[str]:
        """The stages that the program supports at some size: asked once, with a small case, and with a larger one if it has no such."""
        if self._stages is None:
            found: set[str] = set()
            for size in PROBED:
                cases = [smallest_case(stage, size) for stage in self._asked_for if stage not in found]
                results = zip(cases, self.run_many(cases), strict=True)
                found |= {case.stage for case, result in results if not isinstance(result, Unsupported)}
            self._stages = frozenset(found)
        return self._stages

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """Compute one case at a start of its own. Errors as ``run_many``; an unsupported stage is an error too."""
        (result,) = self.run_many([Case(stage, inputs, weights)])
        if isinstance(result, Unsupported):
            raise PortError(f"{self.name}: stage {stage} is unsupported")
        return result

    def run_many(self, cases: Sequence[Case]) -> list[Outputs | Unsupported]:
        """Compute all cases at one start.

        Returns:
            For each case its outputs, with the table's shapes and dtypes; NaN is left to the judge.

        Raises:
            ArrayError: inputs are not those of the stage.
            PortError: the program is not there, fails, takes or says too much, or leaves an
                output missing, damaged, misshapen or of another dtype.
        """
        sizes = [check_inputs(case.stage, case.inputs, DTYPE) for case in cases]

        def read(folder: Path, number: int) -> Outputs | Unsupported:
            return read_outputs(folder, cases[number].stage, sizes[number])

        return self._computed(cases, read) if cases else []

    def layers(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """The layers of one case that it hands over, perhaps none. Errors as ``run_many``."""
        (found,) = self._computed(
            [Case(stage, inputs, weights)], lambda folder, _: read_layers(folder, stage, inputs), layers=True
        )
        return found

    def _computed(self, cases: Sequence[Case], read: Callable[[Path, int], T], *, layers: bool = False) -> list[T]:
        """Start the program on a job of ``cases``, and ``read`` what it left in the folder of each."""
        job = Path(tempfile.mkdtemp(prefix="stss-job-", dir=place_for(cases)))
        results: list[T] = []
        ran = False
        try:
            write_job(job, cases, layers=layers)
            given = stamps_of_inputs(job, len(cases))
            self._start(job)
            ran = True
            require_real(job)
            require_unchanged(given, stamps_of_inputs(job, len(cases)))
            for number in range(len(cases)):
                results.append(read(job / f"{number:04d}", number))
        except JobError as error:
            # Of many starts that fail while a case is made smaller, only the last job is kept.
            if self.kept is not None:
                shutil.rmtree(self.kept, ignore_errors=True)
            self.kept = job
            at = len(results) if ran else _first_unanswered(job, len(cases))
            raise PortError(f"{self.name}: {error}; its job is kept: {job}{self._said()}", at) from error
        except BaseException:
            shutil.rmtree(job, ignore_errors=True)
            raise
        shutil.rmtree(job, ignore_errors=True)
        return results

    def _start(self, job: Path) -> None:
        """Let the program compute ``job``: one that serves goes on, any other is run to its end."""
        try:
            server = self._serving()
        except OSError as error:
            raise PortError(f"{self._command[0]}: cannot be started: {error.strerror or error}") from error
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
                raise PortError(f"{self._command[0]}: cannot be started: {error.strerror or error}") from error
            self.stderr = ending.stderr
        if failed := _failed(ending, self._timeout):
            raise JobError(failed)

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

    def _said(self) -> str:
        return f"\n{self.stderr}" if self.stderr else ""


def place_for(cases: Sequence[Case]) -> Path | None:
    """Where to make a job: in memory where the system has a folder there with room, and nobody asked for another place.

    Thousands of small files take longer on a disk than their numbers to compute. None: the usual place, as ``TMPDIR`` says.
    """
    needed = ROOM * sum(array.nbytes for case in cases for array in case.inputs.values()) + LEAST_ROOM
    usual = tempfile.gettempdir() == "/tmp"
    try:
        return MEMORY if usual and os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free > needed else None
    except OSError:
        return None


def _first_unanswered(job: Path, count: int) -> int | None:
    """Number of the first case of a job that a program has not begun to answer: as a rule that is where it failed."""
    names = (f"{number:04d}" for number in range(count))
    return next(
        (n for n, name in enumerate(names) if not any((job / name / left).exists() for left in ("out", "unsupported"))), None
    )


def _failed(ending: Ending, timeout: float) -> str:
    """The reason why none of the program's outputs counts; "" if there is none."""
    if ending.status is None:
        return f"stopped after {timeout:g} s" if not ending.talked else f"stopped: more than {MOST_SAID >> 20} MiB on its output"
    return describe(ending.status) if ending.status != 0 else ""


def smallest_case(stage: str, size: tuple[int, int] = PROBED[0]) -> Case:
    """Zeros in the smallest sizes that every stage takes, and weights of zeros."""
    row = STAGES[stage]
    dtypes = {"float": DTYPE, "uint8": "uint8", "int": "int32"}
    sizes = {"H": size[0], "W": size[1], "C": 3, "k": 1}
    inputs = {name: np.zeros(spec.shape(sizes), dtypes[spec.kind]) for name, spec in row.inputs.items()}
    return Case(stage, inputs, zeros() if row.weights else None)
