# SPDX-License-Identifier: MIT
"""The judge: gives a port cases, holds what it answers against what is right, and remembers the worst."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from time import monotonic
from typing import Any

import hypothesis
import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from conformance.answers.by_stage import expect
from conformance.answers.expected import Expected, largest
from conformance.answers.port_arithmetic import Arithmetic
from conformance.answers.sums import expected_rounding, rounding
from conformance.findings import DepartureError, Failure, Finding, Record, said
from conformance.protocol.drawn_case import fingerprint
from conformance.protocol.port import Arrays, Case, Outputs, Port, PortError
from conformance.protocol.stages import STAGES, check_inputs, check_outputs
from stss_ref.arrays import ArrayError
from stss_ref.weights import Weights

EVERY_CHECK: list[HealthCheck] = [*HealthCheck]  # pyright: ignore[reportAssignmentType]
MOST_FLOAT16 = 1.0
MOST_BEFORE = 63
"""Cases that are remembered as those before a failure: with it, one start of a program."""
SHRINK_SECONDS = 60.0
"""After which a failing case is as small as it gets."""
MOST_WEIGHTS = 128
"""Sets of weights that are remembered as the port is given them: those of one test."""


@dataclass(frozen=True)
class Tier:
    """How much is tried: cases of a cheap property, of one that runs the network, and large frames."""

    name: str
    cheap: int
    dear: int
    large: int = 1


TIERS = {"quick": Tier("quick", 200, 24, 4), "full": Tier("full", 500, 150, 99)}
Body = Callable[["Judge", Any], None]
"""A property: runs the port on what a case says, and raises DepartureError where it does not hold."""


class Judge:
    """Runs properties on a port.

    Args:
        port: to be judged.
        tier: how many cases.
        seed: of the cases; the same seed gives the same ones.
        shrink: whether a failing case is made as small as it gets.
        repeat: how often each case is computed; other bits at any time are a departure.
        certified: whether anybody has to be able to draw the same cases: they do not depend on answers, and are digested.

    Attributes:
        record: of the test that runs now; the runner puts a new one in its place before each.
    """

    def __init__(
        self,
        port: Port,
        tier: Tier = TIERS["quick"],
        seed: int = 0,
        *,
        shrink: bool = True,
        repeat: int = 1,
        certified: bool = False,
    ):
        self.port, self.tier, self.seed, self.shrink, self.repeat, self.certified = port, tier, seed, shrink, repeat, certified
        self.arithmetic = Arithmetic(port.dtype, bool(getattr(port, "winograd", False)))
        self.stages = port.stages()
        self.record = Record()
        self._last: Case | None = None
        self._near: dict[str, float] = {}  # of one case: what Hypothesis is steered by
        self._before: deque[Any] = deque(maxlen=MOST_BEFORE)
        self._weights: dict[int, tuple[Weights, Weights]] = {}

    def begin(self) -> None:
        """Another test: what the last one met is forgotten."""
        self.record = Record()
        self._before.clear()

    def for_all(
        self, strategy: st.SearchStrategy[Any], body: Body, *, dear: bool = False, drawn: Sequence[Any] | None = None
    ) -> None:
        """Run ``body`` on cases of ``strategy``, towards larger errors.

        A port that takes its cases beforehand (``conformance.rehearsal``) is not steered: they must not depend on its answers.
        So they are ``drawn`` already, and only when one of them fails are they drawn again, to be made smaller.
        """
        if drawn is not None and self._all_right(body, drawn):
            return
        steered = not hasattr(self.port, "prepare") and not self.certified
        phases = [Phase.explicit, Phase.generate, *([Phase.target] if steered else []), *([Phase.shrink] if self.shrink else [])]
        failed_at, failing = 0.0, set[bytes]()

        def run(case: Any) -> None:
            nonlocal failed_at
            if failed_at and monotonic() - failed_at > SHRINK_SECONDS and fingerprint(case) not in failing:
                return
            try:
                self.check(body, case)
            except DepartureError:
                failed_at = failed_at or monotonic()
                failing.add(fingerprint(case))
                raise
            if steered:
                for output, worst in self._near.items():
                    hypothesis.target(worst, label=output)

        self.draw(strategy, run, phases, dear=dear)

    def _all_right(self, body: Body, drawn: Sequence[Any]) -> bool:
        try:
            for case in drawn:
                self.check(body, case)
        except DepartureError:
            if not self.shrink:
                raise
            self.begin()
            return False
        return True

    def check(self, body: Body, case: Any) -> None:
        """Run a property on one case of it; what fails is in the record."""
        self._near = {}
        if self.certified:
            self.record.drawn = sha256(self.record.drawn + fingerprint(case)).digest()
        try:
            body(self, case)
        except DepartureError as error:
            failure = Failure(error.finding, case, tuple(self._before))
            self.record.failure = failure
            self.record.first = self.record.first or failure
            raise
        finally:
            self._before.append(case)

    def draw(
        self, strategy: st.SearchStrategy[Any], take: Callable[[Any], None], phases: list[Phase], *, dear: bool = False
    ) -> None:
        """Hand ``take`` the tier's number of cases; the same ones for the same seed, unless it fails."""

        @hypothesis.seed(self.seed)
        @settings(
            max_examples=self.tier.dear if dear else self.tier.cheap, phases=phases, database=None, deadline=None,
            report_multiple_bugs=False, suppress_health_check=EVERY_CHECK, print_blob=False,
        )  # fmt: skip
        @hypothesis.given(strategy)
        def run(case: Any) -> None:
            take(case)

        run()

    def run(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Outputs:
        """What the port answers, of the right shapes and dtypes.

        Args:
            stage: its name.
            inputs: any floats; the port is given them as its arithmetic holds them, see ``given``.
            weights: for a stage that takes them.

        Raises:
            DepartureError: the port fails, or an output is missing, misshapen or of another dtype.
        """
        case = self.asked(stage, inputs, weights)
        self._last = case
        sizes = check_inputs(stage, case.inputs, "float32")
        self.record.met(sizes)
        try:
            outputs = self._answer(case)
            check_outputs(stage, outputs, sizes)
            again = [self._answer(case) for _ in range(self.repeat - 1)]
        except (ArrayError, PortError) as error:
            raise DepartureError(Finding(f"{stage}: {error}", case, "", None, None)) from error
        for other in again:
            for name, array in other.items():
                self.same(f"{stage}.{name}", np.nan_to_num(array), np.nan_to_num(outputs[name]))
        return outputs

    def asked(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Case:
        """What the port is given for these inputs."""
        return Case(stage, self.given(inputs, stage), None if weights is None else self._given_weights(weights))

    def _given_weights(self, weights: Weights) -> Weights:
        """The same object for the same weights, so that a job holds them once."""
        if id(weights) not in self._weights:
            if len(self._weights) == MOST_WEIGHTS:
                self._weights.clear()
            self._weights[id(weights)] = weights, self.given(weights)
        return self._weights[id(weights)][1]

    def _answer(self, case: Case) -> Outputs:
        """What a port in this process writes into its inputs, or later into its outputs, must not change what it is judged by."""
        if hasattr(self.port, "prepare"):
            return self.port.run(case.stage, case.inputs, case.weights)
        weights = None if case.weights is None else {name: tensor.copy() for name, tensor in case.weights.items()}
        try:
            outputs = self.port.run(case.stage, {name: array.copy() for name, array in case.inputs.items()}, weights)
        except (PortError, ArrayError):
            raise
        except Exception as error:
            # A port is a stranger: whatever it raises is its failure, on this case.
            raise PortError(f"{type(error).__name__}: {error}") from error
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

    def right(
        self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None, got: Outputs | None = None
    ) -> dict[str, Expected]:
        """What is right for these inputs, by output: see ``conformance.answers.by_stage.expect``."""
        given = None if weights is None else self._given_weights(weights)
        return expect(stage, self.exactly(inputs, stage), given, self.arithmetic, got or {})

    def agrees(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Outputs:
        """Run, and hold every output against the float64 reference."""
        outputs = self.run(stage, inputs, weights)
        expected = self.right(stage, inputs, weights, outputs)
        if not expected:
            self._finite(stage, outputs)
        for name, right in expected.items():
            self.holds(f"{stage}.{name}", outputs[name], right)
        return outputs

    def agrees_exactly(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights) -> None:
        """Run a case that needs no rounding: the same bits. Winograd's matrices have thirds, so such a port has its bounds as ever."""
        if self.arithmetic.winograd:
            self.agrees(stage, inputs, weights)
            return
        outputs = self.run(stage, inputs, weights)
        for name, right in self.right(stage, inputs, weights).items():
            self.same(f"{stage}.{name}", outputs[name], right.want)

    def rounds_either_way(
        self, stage: str, output: str, inputs: Mapping[str, NDArray[Any]], weights: Weights, layer: str
    ) -> None:
        """Hold the errors of an output together against what rounding leaves of sums: the products of ``layer``, of one sign."""
        got = self.run(stage, inputs, weights)[output]
        want = self.right(stage, inputs, weights)[output].want
        sums = want != 0
        terms = int(np.prod(weights[f"{layer}.weight"].shape[1:]))
        found = rounding(got[sums], want[sums], terms, self.arithmetic)
        self.holds(f"{stage}.rounding", found, expected_rounding(self.arithmetic))

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
        worst = largest(expected, got)
        self.record.undecided += expected.undecided
        self.record.worst[output] = max(worst, self.record.worst.get(output, 0.0))
        if worst > 1:
            assert self._last is not None
            message = said(output, got, expected, worst)
            raise DepartureError(Finding(message, self._last, output.rsplit(".", maxsplit=1)[-1], got, expected))
        self._near[output] = max(worst, self._near.get(output, 0.0))
