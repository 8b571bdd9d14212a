# SPDX-License-Identifier: MIT
"""The judge: it gives a port cases, compares its answers with the right ones, and records the largest error."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
"""Most cases that are remembered as those before a failure; together with the failing case they fill one run of a program."""
SHRINK_SECONDS = 60.0
"""Most time for making a failing case smaller; seconds."""
MOST_WEIGHTS = 128
"""Most sets of weights that are remembered in the form that the port gets; one test has fewer."""


@dataclass(frozen=True)
class Tier:
    """Numbers of cases: ``fast`` of a fast property, ``slow`` of one that runs the network, at most ``large`` large frames."""

    name: str
    fast: int
    slow: int
    large: int = 1


TIERS = {"quick": Tier("quick", 200, 24, 4), "full": Tier("full", 500, 150, 99)}
Body = Callable[["Judge", Any], None]
"""A property: it runs the port on a case, and raises DepartureError if the property does not hold."""


class Judge:
    """Runs properties on a port.

    Args:
        port: to be judged.
        tier: number of cases.
        seed: of the cases; the same seed gives the same cases.
        shrink: make a failing case smaller.
        repeat: number of times that each case is computed; different bits in any of them are a departure.

    Attributes:
        record: of the test that runs now; the runner sets a new one before each test.
    """

    def __init__(
        self,
        port: Port,
        tier: Tier = TIERS["quick"],
        seed: int = 0,
        *,
        shrink: bool = True,
        repeat: int = 1,
    ):
        self.port, self.tier, self.seed, self.shrink, self.repeat = port, tier, seed, shrink, repeat
        self.arithmetic = Arithmetic(port.dtype, bool(getattr(port, "winograd", False)))
        self.stages = port.stages()
        self.record = Record()
        self._last: Case | None = None
        self._near: dict[str, float] = {}  # largest error / bound in the last case, which steers Hypothesis
        self._before: deque[Any] = deque(maxlen=MOST_BEFORE)
        self._weights: dict[int, tuple[Weights, Weights]] = {}

    def begin(self) -> None:
        """Begin another test: forget the record and cases of the last one."""
        self.record = Record()
        self._before.clear()

    def for_all(
        self, strategy: st.SearchStrategy[Any], body: Body, *, slow: bool = False, drawn: Sequence[Any] | None = None
    ) -> None:
        """Run ``body`` on cases of ``strategy``, steered towards larger errors.

        The cases of a port that computes them beforehand (``conformance.rehearsal``) are not steered, since they must not depend on
        its answers. They are ``drawn`` already, and are drawn again only if one of them fails, to make it smaller. Of ``slow``
        cases fewer are drawn. Raises DepartureError as ``check``.
        """
        if drawn is not None and self._all_right(body, drawn):
            return
        steered = not hasattr(self.port, "prepare")
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

        self.draw(strategy, run, phases, slow=slow)

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
        """Run a property on one of its cases; DepartureError if it does not hold, with the failure in ``record``."""
        self._near = {}
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
        self, strategy: st.SearchStrategy[Any], take: Callable[[Any], None], phases: list[Phase], *, slow: bool = False
    ) -> None:
        """Call ``take`` with as many cases as the tier says; the same seed gives the same cases, unless ``take`` raises."""

        @hypothesis.seed(self.seed)
        @settings(
            max_examples=self.tier.slow if slow else self.tier.fast, phases=phases, database=None, deadline=None,
            report_multiple_bugs=False, suppress_health_check=EVERY_CHECK, print_blob=False,
        )  # fmt: skip
        @hypothesis.given(strategy)
        def run(case: Any) -> None:
            take(case)

        run()

    def run(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Outputs:
        """Run the port on a case.

        Args:
            stage: name of the stage.
            inputs: any floats; the port gets them rounded to its arithmetic, see ``given``.
            weights: for a stage that takes them.

        Returns:
            The port's outputs, with the right shapes and dtypes.

        Raises:
            DepartureError: the port fails, or an output is missing or has the wrong shape or dtype.
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
        """The case that the port gets for these inputs."""
        return Case(stage, self.given(inputs, stage), None if weights is None else self._given_weights(weights))

    def _given_weights(self, weights: Weights) -> Weights:
        """The weights as the port gets them, the same object for the same weights, so that a job has them once."""
        if id(weights) not in self._weights:
            if len(self._weights) == MOST_WEIGHTS:
                self._weights.clear()
            self._weights[id(weights)] = weights, self.given(weights)
        return self._weights[id(weights)][1]

    def _answer(self, case: Case) -> Outputs:
        """The port's answer. Arrays are copied, since a port in this process may write to its inputs, or later to its outputs."""
        if hasattr(self.port, "prepare"):
            return self.port.run(case.stage, case.inputs, case.weights)
        weights = None if case.weights is None else {name: tensor.copy() for name, tensor in case.weights.items()}
        try:
            outputs = self.port.run(case.stage, {name: array.copy() for name, array in case.inputs.items()}, weights)
        except (PortError, ArrayError):
            raise
        except Exception as error:
            # The port is foreign code: anything that it raises is a failure on this case.
            raise PortError(f"{type(error).__name__}: {error}") from error
        return {name: array.copy() for name, array in outputs.items()}

    def given(self, arrays: Arrays, stage: str = "") -> dict[str, NDArray[Any]]:
        """``arrays`` as the port gets them: float32, rounded to numbers that its arithmetic has.

        Stages of the network of a float16 port get no number beyond ``MOST_FLOAT16``, so that activations fit into float16, too.
        """
        narrow = self.arithmetic.dtype == "float16" and stage in STAGES and STAGES[stage].weights
        return {name: self.arithmetic.rounded(array, MOST_FLOAT16 if narrow else None) for name, array in arrays.items()}

    def exactly(self, arrays: Arrays, stage: str) -> dict[str, NDArray[Any]]:
        """The numbers of ``given`` in float64, for the reference."""
        given = self.given(arrays, stage)
        return {name: array.astype(np.float64) if array.dtype.kind == "f" else array for name, array in given.items()}

    def right(
        self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None, got: Outputs | None = None
    ) -> dict[str, Expected]:
        """The right answers for these inputs, by output: see ``conformance.answers.by_stage.expect``."""
        given = None if weights is None else self._given_weights(weights)
        return expect(stage, self.exactly(inputs, stage), given, self.arithmetic, got or {})

    def agrees(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Outputs:
        """Run the port, and raise DepartureError unless every output is within its bound of the float64 reference."""
        outputs = self.run(stage, inputs, weights)
        expected = self.right(stage, inputs, weights, outputs)
        if not expected:
            self._finite(stage, outputs)
        for name, right in expected.items():
            self.holds(f"{stage}.{name}", outputs[name], right)
        return outputs

    def agrees_exactly(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights) -> None:
        """Run a case that needs no rounding, and expect the right bits; a Winograd port has its bounds, since its matrices have thirds."""
        if self.arithmetic.winograd:
            self.agrees(stage, inputs, weights)
            return
        outputs = self.run(stage, inputs, weights)
        for name, right in self.right(stage, inputs, weights).items():
            self.same(f"{stage}.{name}", outputs[name], right.want)

    def rounds_either_way(
        self, stage: str, output: str, inputs: Mapping[str, NDArray[Any]], weights: Weights, layer: str
    ) -> None:
        """Compare all errors of an output with those of sums that round either way; the sums' terms, of ``layer``, have one sign."""
        got = self.run(stage, inputs, weights)[output]
        want = self.right(stage, inputs, weights)[output].want
        sums = want != 0
        terms = int(np.prod(weights[f"{layer}.weight"].shape[1:]))
        found = rounding(got[sums], want[sums], terms, self.arithmetic)
        self.holds(f"{stage}.rounding", found, expected_rounding(self.arithmetic))

    def _finite(self, stage: str, outputs: Outputs) -> None:
        """Expect finite numbers only, of an answer that cannot be judged since rounding decides on the whole of it."""
        self.record.unjudged += 1
        for name, got in outputs.items():
            if not np.isfinite(got).all():
                self.holds(f"{stage}.{name}", got, Expected(np.where(np.isfinite(got), got, 0), 0.0))

    def same(self, output: str, got: NDArray[Any], want: NDArray[Any]) -> None:
        """Raise DepartureError unless the numbers are equal; 0 equals -0, and a denormal number may be 0."""
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
