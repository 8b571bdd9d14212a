# SPDX-License-Identifier: MIT
"""Judge a program with few starts: a rehearsal finds the cases that a test needs, and one start of the program computes many of them.

A rehearsal is a judge that runs cases and does not judge; its port is the program with a memory. The judge itself is unaware of both.
"""

from __future__ import annotations

import hashlib
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from hypothesis import Phase
from hypothesis import strategies as st
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.judge import MOST_WEIGHTS, Body, Judge
from conformance.protocol.array_specs import Sizes
from conformance.protocol.port import Arrays, Case, Outputs, PortError, Unsupported
from conformance.protocol.program_port import FolderPort, remove_tree
from conformance.protocol.stages import STAGES, check_inputs
from stss_ref.weights import Weights

BATCH = 64
"""Most cases in one start of a program."""
BATCH_BYTES = 256 * 2**20
"""Most bytes of inputs in one start of a program."""


class PreparedPort:
    """A program as a port that takes the answers of prepared cases from memory, and starts the program for other cases.

    Attributes:
        program: computes the answers.
        name, dtype: of the program.
        answers: of the prepared cases, by their digests; a case that was prepared twice has two, in order.
        failed: by the digests of its cases, a start that failed as a whole.
    """

    def __init__(self, program: FolderPort):
        self.program = program
        # A thread removes folders while the judge goes on: some file systems take milliseconds for each.
        removing = ThreadPoolExecutor(1)
        program.remove = partial(removing.submit, remove_tree)
        self.name, self.dtype = program.name, program.dtype
        self.answers: dict[bytes, list[Outputs]] = {}
        self.failed: dict[bytes, _FailedStart] = {}

    def stages(self) -> frozenset[str]:
        """See ``FolderPort``."""
        return self.program.stages()

    def forget(self) -> None:
        """Forget all prepared cases."""
        self.answers, self.failed = {}, {}

    def prepare(self, cases: Sequence[Case]) -> None:
        """Compute ``cases`` with as few starts as possible; the cases of a start that fails are computed later, one by one."""
        for some in _batches(cases):
            try:
                answers = self.program.run_many(some)
            except PortError as error:
                start = _FailedStart(error, len(some), {digest(case) for case in some})
                self.failed |= dict.fromkeys(start.left, start)
                continue
            for case, answer in zip(some, answers, strict=True):
                if not isinstance(answer, Unsupported):
                    self.answers.setdefault(digest(case), []).append(answer)

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """See ``conformance.protocol.port.Port``."""
        key = digest(Case(stage, inputs, weights))
        if key in self.answers:
            # A property that runs a case twice gets the second answer the second time.
            answers = self.answers[key]
            answers.append(answers.pop(0))
            return answers[-1]
        outputs = self._started(stage, inputs, weights)
        if key in self.failed:
            self.failed[key].passed_alone(key)
        return outputs

    def layers(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """See ``FolderPort``."""
        return self.program.layers(stage, inputs, weights)

    def _started(self, stage: str, inputs: Arrays, weights: Weights | None) -> Outputs:
        """Start the program for this case alone. Of many starts that fail while a case is made smaller, only the last job is kept."""
        before, self.program.kept = self.program.kept, None
        try:
            return self.program.run(stage, inputs, weights)
        finally:
            if before is not None and self.program.kept is not None:
                shutil.rmtree(before, ignore_errors=True)
            self.program.kept = self.program.kept or before


@dataclass
class _FailedStart:
    """A job of several cases that failed as a whole.

    Attributes:
        error: of the start.
        count: number of cases in the job.
        left: digests of the cases that have not yet passed alone.
    """

    error: PortError
    count: int
    left: set[bytes]

    def passed_alone(self, key: bytes) -> None:
        """Note that a case passed alone; if every case does, raise the job's own failure, which no single case explains."""
        self.left.discard(key)
        if not self.left:
            raise PortError(f"depends on the cases before: each passes alone, but not {self.count} in one job: {self.error}")


def _batches(cases: Sequence[Case]) -> list[list[Case]]:
    batches: list[list[Case]] = []
    room = 0
    for case in cases:
        size = sum(array.nbytes for array in case.inputs.values())
        if not batches or len(batches[-1]) == BATCH or size > room:
            batches.append([])
            room = BATCH_BYTES
        batches[-1].append(case)
        room -= size
    return batches


def digest(case: Case) -> bytes:
    """Digest of a case: of its stage, inputs and weights."""
    digested = hashlib.blake2b(case.stage.encode())
    _take(digested, case.inputs)
    if case.weights is not None:
        digested.update(_digest_of_weights(case.weights))
    return digested.digest()


def _take(digested: Any, arrays: Arrays) -> None:
    for name, array in arrays.items():
        digested.update(f"{name}{array.shape}{array.dtype.str}".encode())
        digested.update(np.ascontiguousarray(array).data)


_WEIGHTS: dict[int, tuple[Weights, bytes]] = {}
"""Digests of weights by their identity. The weights are kept alive, so that no other object gets their identity."""


def _digest_of_weights(weights: Weights) -> bytes:
    """Digest of weights; each object is digested once, since the judge has one object for the same weights and changes none."""
    if id(weights) not in _WEIGHTS:
        if len(_WEIGHTS) == MOST_WEIGHTS:
            _WEIGHTS.clear()
        digested = hashlib.blake2b()
        _take(digested, weights)
        _WEIGHTS[id(weights)] = weights, digested.digest()
    return _WEIGHTS[id(weights)][1]


class Rehearsal(Judge):
    """A judge that runs the cases that a judge will run; it takes zeros for a missing answer, and finds everything right.

    Attributes:
        missing: cases without an answer, by the number of times that their property ran them before, and their digests.
    """

    def __init__(self, judge: Judge, port: PreparedPort):
        super().__init__(judge.port, judge.tier, judge.seed, repeat=judge.repeat)
        self.missing: dict[tuple[int, bytes], Case] = {}
        self._prepared, self._weights = port, judge._weights
        self._asked: Counter[bytes] = Counter()

    def asks_more(self, body: Body, drawn: Any) -> bool:
        """Run a property on a case; returns whether it needed a missing answer."""
        self._asked.clear()
        before = len(self.missing)
        body(self, drawn)
        return len(self.missing) > before

    def run(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Outputs:
        """The port's answer, or zeros if it is missing."""
        case = self.asked(stage, inputs, weights)
        sizes = check_inputs(stage, case.inputs, "float32")
        key = digest(case)
        answers, asked = self._prepared.answers.get(key, []), self._asked[key]
        self._asked[key] += self.repeat
        if key not in self._prepared.failed:
            self.missing |= {(i, key): case for i in range(max(asked, len(answers)), asked + self.repeat)}
        return answers[asked] if asked < len(answers) else _zeros(stage, sizes)

    def right(
        self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None, got: Outputs | None = None
    ) -> dict[str, Expected]:
        """Zeros as right answers, which are compared with nothing."""
        sizes = check_inputs(stage, self.given(inputs, stage), "float32")
        return {name: Expected(zeros, 0.0) for name, zeros in _zeros(stage, sizes).items()}

    def rounds_either_way(
        self, stage: str, output: str, inputs: Mapping[str, NDArray[Any]], weights: Weights, layer: str
    ) -> None:
        """Run the case, and judge nothing."""
        self.run(stage, inputs, weights)

    def holds(self, output: str, got: NDArray[Any], expected: Expected) -> None:
        """Judge nothing."""


def _zeros(stage: str, sizes: Sizes) -> Outputs:
    kinds = {"float": np.float32, "uint8": np.uint8, "int": np.int32}
    return {name: np.zeros(spec.shape(sizes), kinds[spec.kind]) for name, spec in STAGES[stage].outputs.items()}


def rehearse(judge: Judge, strategy: st.SearchStrategy[Any], body: Body, *, slow: bool = False) -> list[Any] | None:
    """Prepare the answers that ``judge.for_all`` will need from a program; returns the drawn cases, or None if the port is no program."""
    if not isinstance(judge.port, PreparedPort):
        return None
    drawn: list[Any] = []
    judge.draw(strategy, drawn.append, [Phase.generate], slow=slow)
    prepare(judge, drawn, body)
    return drawn


def prepare(judge: Judge, drawn: Sequence[Any], body: Body) -> None:
    """Prepare the answers that a property needs from a program on the cases ``drawn``.

    A property whose further runs depend on an answer is rehearsed again with that answer, until nothing is missing.
    """
    port = judge.port
    if not isinstance(port, PreparedPort):
        return
    port.forget()
    while drawn:
        rehearsal = Rehearsal(judge, port)
        drawn = [case for case in drawn if rehearsal.asks_more(body, case)]
        # A case that runs twice is computed again after all others, not right after itself.
        port.prepare([rehearsal.missing[key] for key in sorted(rehearsal.missing, key=lambda key: key[0])])
