# SPDX-License-Identifier: MIT
"""The judge: gives a port cases, holds what it answers against what is right, and remembers the worst."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import hypothesis
import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from conformance.answers.by_stage import expect
from conformance.answers.expected import Expected, largest
from conformance.answers.port_arithmetic import Arithmetic
from conformance.protocol.array_specs import Sizes
from conformance.protocol.port import Arrays, Case, Outputs, Port, PortError, Unsupported
from conformance.protocol.program_port import FolderPort
from conformance.protocol.stages import STAGES, check_inputs, check_outputs
from stss_ref.arrays import ArrayError
from stss_ref.weights import Weights

EVERY_CHECK: list[HealthCheck] = [*HealthCheck]  # pyright: ignore[reportAssignmentType]
MOST_FLOAT16 = 1.0
BATCH = 64
"""Cases of a program's one start."""


class DepartureError(AssertionError):
    """A port's answer is wrong: the message says where and by how much."""

    def __init__(self, finding: Finding):
        super().__init__(finding.message)
        self.finding = finding


@dataclass(frozen=True)
class Finding:
    """One wrong output: enough to show it and to run it again.

    Attributes:
        message: what departs, where, by how much.
        case: what the port was given.
        output: name of the wrong output.
        got: what the port answered.
        expected: what is right.
    """

    message: str
    case: Case
    output: str
    got: NDArray[Any] | None
    expected: Expected | None


@dataclass
class Record:
    """What one test met."""

    cases: int = 0
    undecided: int = 0
    unjudged: int = 0
    worst: dict[str, float] = field(default_factory=dict[str, float])
    finding: Finding | None = None


@dataclass(frozen=True)
class Tier:
    """How much is tried: cases of a cheap property, and of one that runs the network."""

    name: str
    cheap: int
    dear: int


TIERS = {"quick": Tier("quick", 200, 24), "full": Tier("full", 500, 150)}


class Judge:
    """Runs properties on a port.

    Args:
        port: to be judged.
        tier: how many cases.
        seed: of the cases; the same seed gives the same ones.
        shrink: whether a failing case is made as small as it gets.

    Attributes:
        record: of the test that runs now; the runner puts a new one in its place before each.
    """

    def __init__(self, port: Port, tier: Tier = TIERS["quick"], seed: int = 0, *, shrink: bool = True):
        self.port, self.tier, self.seed, self.shrink = port, tier, seed, shrink
        self.arithmetic = Arithmetic(port.dtype, bool(getattr(port, "winograd", False)))
        self.stages = port.stages()
        self.record = Record()
        self._rehearsed: list[Case] | None = None
        self._answers: dict[bytes, Outputs] = {}
        self._last: Case | None = None
        self._near: dict[str, float] = {}  # of one case: what Hypothesis is steered by

    def for_all(self, strategy: st.SearchStrategy[Any], body: Callable[[Any], None], *, dear: bool = False) -> None:
        """Run ``body`` on cases of ``strategy``; a program is started once for many of them.

        A program's cases are found by a rehearsal, in which nothing is judged: Hypothesis draws the same ones again afterwards. For
        that, it must not be steered by what the port answers.
        """
        count = self.tier.dear if dear else self.tier.cheap
        program = isinstance(self.port, FolderPort)
        if program:
            self._rehearse(strategy, body, count)
        phases = [Phase.explicit, Phase.generate]
        if not program:
            phases.append(Phase.target)
        if self.shrink:
            phases.append(Phase.shrink)
        self._hypothesis(strategy, body, count, phases)

    def _hypothesis(self, strategy: st.SearchStrategy[Any], body: Callable[[Any], None], count: int, phases: list[Phase]) -> None:
        @hypothesis.seed(self.seed)
        @settings(
            max_examples=count, phases=phases, database=None, deadline=None, report_multiple_bugs=False,
            suppress_health_check=EVERY_CHECK, print_blob=False,
        )  # fmt: skip
        @hypothesis.given(strategy)
        def run(case: Any) -> None:
            self._near = {}
            body(case)
            if Phase.target in phases:
                for output, worst in self._near.items():
                    hypothesis.target(worst, label=output)

        run()

    def _rehearse(self, strategy: st.SearchStrategy[Any], body: Callable[[Any], None], count: int) -> None:
        self._rehearsed, self._answers = [], {}
        try:
            self._hypothesis(strategy, body, count, [Phase.generate])
            cases = {_key(case): case for case in self._rehearsed}
        finally:
            self._rehearsed = None
        keys = list(cases)
        assert isinstance(self.port, FolderPort)
        for first in range(0, len(keys), BATCH):
            some = keys[first : first + BATCH]
            for key, answer in zip(some, self.port.run_many([cases[key] for key in some]), strict=True):
                if not isinstance(answer, Unsupported):
                    self._answers[key] = answer

    def run(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Outputs:
        """What the port answers, of the right shapes and dtypes.

        Args:
            stage: its name.
            inputs: any floats; the port is given them as its arithmetic holds them, see ``given``.
            weights: for a stage that takes them.

        Raises:
            DepartureError: the port fails, or an output is missing, misshapen or of another dtype.
        """
        case = Case(stage, self.given(inputs, stage), None if weights is None else self.given(weights))
        self._last = case
        sizes = check_inputs(stage, case.inputs, "float32")
        if self._rehearsed is not None:
            self._rehearsed.append(case)
            return _zeros(stage, sizes)
        self.record.cases += 1
        try:
            outputs = self._answers.get(_key(case)) if self._answers else None
            if outputs is None:
                outputs = self._answer(case)
            check_outputs(stage, outputs, sizes)
        except (ArrayError, PortError) as error:
            raise DepartureError(Finding(f"{stage}: {error}", case, "", None, None)) from error
        return outputs

    def _answer(self, case: Case) -> Outputs:
        """What a port in this process writes into its inputs, or later into its outputs, must not change what it is judged by."""
        if isinstance(self.port, FolderPort):
            return self.port.run(case.stage, case.inputs, case.weights)
        weights = None if case.weights is None else {name: tensor.copy() for name, tensor in case.weights.items()}
        outputs = self.port.run(case.stage, {name: array.copy() for name, array in case.inputs.items()}, weights)
        return {name: array.copy() for name, array in outputs.items()}

    def given(self, arrays: Arrays, stage: str = "") -> dict[str, NDArray[Any]]:
        """``arrays`` as the port is given them: float32, of numbers that its arithmetic holds.

        The network's stages of a float16 port get none beyond ``MOST_FLOAT16``: its activations have to fit, too.
        """
        narrow = self.arithmetic.dtype == "float16" and stage in STAGES and STAGES[stage].weights
        return {name: self.arithmetic.rounded(array, MOST_FLOAT16 if narrow else None) for name, array in arrays.items()}

    def exactly(self, arrays: Arrays, stage: str) -> dict[str, NDArray[Any]]:
        """The same numbers in float64, for the reference."""
        given = self.given(arrays, stage)
        return {name: array.astype(np.float64) if array.dtype.kind == "f" else array for name, array in given.items()}

    def agrees(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Outputs:
        """Run, and hold every output against the float64 reference."""
        outputs = self.run(stage, inputs, weights)
        if self._rehearsed is None:
            case = self._last
            assert case is not None
            expected = expect(stage, self.exactly(inputs, stage), case.weights, self.arithmetic, outputs)
            if not expected:
                self._finite(stage, outputs)
            for name, right in expected.items():
                self.holds(f"{stage}.{name}", outputs[name], right)
        return outputs

    def _finite(self, stage: str, outputs: Outputs) -> None:
        """Rounding decides on the whole answer; but not on whether it is a number."""
        self.record.unjudged += 1
        for name, got in outputs.items():
            if not np.isfinite(got).all():
                self.holds(f"{stage}.{name}", got, Expected(np.where(np.isfinite(got), got, 0), 0.0))

    def same(self, output: str, got: NDArray[Any], want: NDArray[Any]) -> None:
        """The very same numbers; 0 and -0 are the same, and numbers too small to be normal may be 0."""
        want = np.asarray(want)
        self.holds(output, got, Expected(want, self.arithmetic.flushed(want)))

    def holds(self, output: str, got: NDArray[Any], expected: Expected) -> None:
        """Raise DepartureError unless ``got`` is right; ``output`` is ``stage.name``, as in the table of bounds."""
        if self._rehearsed is not None:
            return
        worst = largest(expected, got)
        self.record.undecided += expected.undecided
        self.record.worst[output] = max(worst, self.record.worst.get(output, 0.0))
        if worst > 1:
            assert self._last is not None
            raise DepartureError(
                Finding(_say(output, got, expected, worst), self._last, output.rsplit(".", maxsplit=1)[-1], got, expected)
            )
        self._near[output] = max(worst, self._near.get(output, 0.0))


def _say(output: str, got: NDArray[Any], expected: Expected, worst: float) -> str:
    if got.shape != expected.want.shape:
        return f"{output}: expected shape {expected.want.shape}, got {got.shape}"
    ratios = expected.ratios(got)
    place = tuple(int(i) for i in np.unravel_index(int(ratios.argmax()), ratios.shape))
    allowed = float(np.broadcast_to(np.asarray(expected.allowed), got.shape)[place])
    by = "wrong" if allowed == 0 else f"error / bound {worst:.3g}"
    share = float((ratios > 1).mean())
    return (
        f"{output}: {by} at {list(place)}: got {got[place]:.9g}, expected {expected.want[place]:.9g}"
        f"{f', allowed {allowed:.3g}' if allowed else ''}; {share:.1%} of {got.size} numbers depart"
    )


def _key(case: Case) -> bytes:
    import hashlib

    digest = hashlib.sha256(case.stage.encode())
    for name, array in [*case.inputs.items(), *(case.weights or {}).items()]:
        digest.update(f"{name}{array.shape}{array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()


def _zeros(stage: str, sizes: Sizes) -> Outputs:
    kinds = {"float": np.float32, "uint8": np.uint8, "int": np.int32}
    return {name: np.zeros(spec.shape(sizes), kinds[spec.kind]) for name, spec in STAGES[stage].outputs.items()}


def tallied(records: Sequence[Record]) -> Counter[str]:
    """Cases, undecided numbers and unjudged cases of several tests together."""
    return Counter({
        "cases": sum(r.cases for r in records),
        "undecided": sum(r.undecided for r in records),
        "unjudged": sum(r.unjudged for r in records),
    })  # fmt: skip
