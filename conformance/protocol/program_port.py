# SPDX-License-Identifier: MIT
"""A port that is a program: it is called with a job folder and leaves its outputs there (spec 11)."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from conformance.protocol.job_folder import DTYPE, JobError, read_outputs, write_job
from conformance.protocol.port import Arrays, Case, Outputs, PortError, Unsupported
from conformance.protocol.stages import STAGES, check_inputs
from stss_ref.weights import Weights, zeros

TAIL_BYTES = 2000
"""How much of the end of stderr an error shows."""


class FolderPort:
    """Runs a program on job folders, many cases at a start.

    A job folder is removed when all went well. Otherwise it is kept, with ``stderr.txt`` and ``stdout.txt`` in it, and the
    error names it.

    Attributes:
        name: of the program, without its folder.
        dtype: the program's arithmetic; the files are float32 in any case.
        stderr: the end of what the program's last run wrote there.
    """

    def __init__(self, command: Sequence[str], timeout: float, dtype: str = DTYPE):
        """Make a port of a command.

        Args:
            command: program and arguments; the job folder is added as the last one.
            timeout: seconds for one start, whatever the number of cases.
            dtype: ``float32`` or ``float16``.
        """
        self.name = Path(command[0]).name
        self.dtype = dtype
        self.stderr = ""
        self._command = list(command)
        self._timeout = timeout
        self._stages: frozenset[str] | None = None

    def stages(self) -> frozenset[str]:
        """What the program does not call unsupported: asked once, with the smallest case of each stage."""
        if self._stages is None:
            results = self.run_many([smallest_case(stage) for stage in STAGES])
            self._stages = frozenset(s for s, result in zip(STAGES, results, strict=True) if not isinstance(result, Unsupported))
        return self._stages

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """One case, at a start of its own. Errors as ``run_many``; an unsupported stage is one too."""
        (result,) = self.run_many([Case(stage, inputs, weights)])
        if isinstance(result, Unsupported):
            raise PortError(f"{self.name}: stage {stage} is unsupported")
        return result

    def run_many(self, cases: Sequence[Case]) -> list[Outputs | Unsupported]:
        """All cases at one start.

        Returns:
            For each case its outputs, of the table's shapes and dtypes; NaN is left to be judged.

        Raises:
            ArrayError: inputs are not what a stage takes.
            PortError: the program is not there, fails, takes too long, or leaves an output missing, damaged, misshapen or
                of another dtype.
        """
        if not cases:
            return []
        sizes = [check_inputs(case.stage, case.inputs, DTYPE) for case in cases]
        job = Path(tempfile.mkdtemp(prefix="stss-job-"))
        try:
            write_job(job, cases)
            self._start(job)
            folders = [job / f"{number:04d}" for number in range(len(cases))]
            results = [read_outputs(*case) for case in zip(folders, [case.stage for case in cases], sizes, strict=True)]
        except JobError as error:
            raise PortError(f"{self.name}: {error}{self._said()}") from error
        except PortError:
            raise
        except BaseException:
            shutil.rmtree(job, ignore_errors=True)
            raise
        shutil.rmtree(job, ignore_errors=True)
        return results

    def _start(self, job: Path) -> None:
        """Run the program on ``job`` to its end."""
        with (job / "stdout.txt").open("wb") as out, (job / "stderr.txt").open("wb") as err:
            try:
                process = subprocess.Popen(
                    [*self._command, str(job)],
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=err,
                    start_new_session=True,
                )
            except OSError as error:
                shutil.rmtree(job, ignore_errors=True)
                raise PortError(f"{self._command[0]}: cannot be started: {error.strerror or error}") from error
            status = None
            try:
                with suppress(subprocess.TimeoutExpired):
                    status = process.wait(self._timeout)
            finally:
                _end(process)
        self.stderr = _tail(job / "stderr.txt")
        if status != 0:
            how = f"stopped after {self._timeout:g} s" if status is None else _ending(status)
            raise PortError(f"{self.name}: {how}; its job is kept: {job}{self._said()}")

    def _said(self) -> str:
        return f"\n{self.stderr}" if self.stderr else ""


def smallest_case(stage: str) -> Case:
    """Zeros in the smallest sizes that every stage takes, and weights of zeros."""
    row = STAGES[stage]
    dtypes = {"float": DTYPE, "uint8": "uint8", "int": "int32"}
    sizes = {"H": 8, "W": 8, "C": 3, "k": 1}
    inputs = {name: np.zeros(spec.shape(sizes), dtypes[spec.kind]) for name, spec in row.inputs.items()}
    return Case(stage, inputs, zeros() if row.weights else None)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the program, if it still runs, with what it has started itself."""
    if process.poll() is not None:
        return
    if os.name == "posix":
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.wait()


def _ending(status: int) -> str:
    if status >= 0:
        return f"ended with status {status}"
    try:
        return f"ended by {signal.Signals(-status).name}"
    except ValueError:
        return f"ended by signal {-status}"


def _tail(path: Path) -> str:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - TAIL_BYTES))
        return file.read().decode(errors="replace").strip()
