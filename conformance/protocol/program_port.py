# SPDX-License-Identifier: MIT
"""A port that is a program: it is called with a job folder and leaves its outputs there (spec 11)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from time import monotonic

import numpy as np

from conformance.protocol.job_folder import DTYPE, read_layers, read_outputs, write_job
from conformance.protocol.port import Arrays, Case, Outputs, PortError, Unsupported
from conformance.protocol.program import NotStartedError, Program
from conformance.protocol.stages import STAGES, check_inputs
from stss_ref.weights import Weights, zeros

PROBE_SIZES = ((8, 8), (72, 136))
"""(H, W) at which a program is asked for its stages."""


class FolderPort(Program):
    """Runs a program on job folders, with many cases at one start.

    Attributes:
        dtype: the program's arithmetic; the files are float32 in any case.
    """

    def __init__(
        self, command: Sequence[str], timeout: float, dtype: str = DTYPE, stages: Iterable[str] = STAGES, *, keep: bool = True
    ):
        """Make a port of a command.

        Args:
            command: program and arguments; the job folder is added as the last one.
            timeout: seconds for one start, whatever the number of cases.
            dtype: ``float32`` or ``float16``.
            stages: the stages to ask for; all others count as lacking.
            keep: as of `Program`.
        """
        super().__init__(command, timeout, keep=keep)
        self._asked_for = [stage for stage in STAGES if stage in set(stages)]
        self.dtype = dtype
        self._stages: frozenset[str] | None = None

    def stages(self) -> frozenset[str]:
        """The stages that the program supports at some size: asked once, with a small case and, without success, a larger one.

        A stage at which it fails is one of them, and fails its tests.

        Raises:
            PortError: the program cannot be started, or fails at each of several stages.
        """
        if self._stages is None:
            stages: set[str] = set()
            for size in PROBE_SIZES:
                cases = [smallest_case(stage, size) for stage in self._asked_for if stage not in stages]
                answers = zip(cases, self._probe(cases), strict=True)
                stages |= {case.stage for case, answer in answers if not isinstance(answer, Unsupported)}
            self._stages = frozenset(stages)
        return self._stages

    def _probe(self, cases: Sequence[Case]) -> Sequence[Outputs | Unsupported | PortError]:
        """The answers at one start; where that fails, each at a start of its own, as long as any is answered in time."""
        try:
            return self.run_many(cases)
        except NotStartedError:
            raise
        except PortError as error:
            if len(cases) == 1:
                return [error]
        answers: list[Outputs | Unsupported | PortError] = []
        end = monotonic() + self._timeout
        for case in cases:
            try:
                answers += self.run_many([case])
            except PortError as error:
                answers.append(error)
            if monotonic() > end:
                break
        if all(isinstance(answer, PortError) for answer in answers):
            few = cases[0].stage
            raise PortError(f"{few} and each other stage that was asked for fails; --stages {few} judges it alone; {answers[0]}")
        return answers

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

        return self.compute(cases, lambda job: write_job(job, cases), read) if cases else []

    def layers(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """The layers that it returns for one case, perhaps none. Errors as ``run_many``."""
        cases = [Case(stage, inputs, weights)]
        (layers,) = self.compute(
            cases, lambda job: write_job(job, cases, layers=True), lambda folder, _: read_layers(folder, stage, inputs)
        )
        return layers


def smallest_case(stage: str, size: tuple[int, int] = PROBE_SIZES[0]) -> Case:
    """Zeros in the smallest sizes that every stage takes, and weights of zeros."""
    row = STAGES[stage]
    dtypes = {"float": DTYPE, "uint8": "uint8", "int": "int32"}
    sizes = {"H": size[0], "W": size[1], "C": 3, "k": 1}
    inputs = {name: np.zeros(spec.shape(sizes), dtypes[spec.kind]) for name, spec in row.inputs.items()}
    return Case(stage, inputs, zeros() if row.weights else None)
