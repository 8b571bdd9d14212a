# SPDX-License-Identifier: MIT
"""Cases with their right answers, for tests without the judge: of every property that needs no more than a stored answer."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.port_arithmetic import Arithmetic
from conformance.judging.judge import Judge, Tier
from conformance.judging.questions import Talk
from conformance.protocol.drawn_case import fingerprint
from conformance.protocol.port import Arrays, Case, Outputs
from conformance.protocol.stages import STAGES
from stss_ref.weights import Weights


@dataclass(frozen=True)
class StoredCase:
    """One case and its right answers, by output."""

    case: Case
    expected: Mapping[str, Expected]


@dataclass(frozen=True)
class StoredTest:
    """The parts of a test that can be stored.

    Attributes:
        id: ``stage.test``.
        property: in words.
        cases: of it; those that an earlier test has are not there again. None: it holds answers of a port against each other.
        undecided: number of cases that are left out, since rounding decides a whole answer.
    """

    id: str
    property: str
    cases: list[StoredCase] | None
    undecided: int


def stored_tests(stages: Iterable[str], arithmetic: Arithmetic, tier: Tier, seed: int) -> Generator[StoredTest, None, None]:
    """The tests of some stages, in the order of the suite.

    Args:
        stages: names of the files of ``conformance/suite``.
        arithmetic: of the ports that are to be tested.
        tier: how many cases.
        seed: of the cases; the same seed gives the same ones, and those that a program is judged on.
    """
    collector = _Collector(arithmetic, tier, seed)
    for stage in stages:
        for name, test in vars(import_module(f"conformance.suite.test_{stage}")).items():
            if name.startswith("test_"):
                yield collector.collect(f"{stage}.{name.removeprefix('test_')}", test)


class _PropertyError(Exception):
    """A test asks for an answer to hold another one against it."""


class _NoPort:
    """Stands for a port; it is never asked."""

    name = "none"

    def __init__(self, arithmetic: Arithmetic):
        self.dtype, self.winograd = arithmetic.dtype, arithmetic.winograd

    def stages(self) -> frozenset[str]:
        return frozenset(STAGES)

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        raise AssertionError("no port is asked")


class _Collector(Judge):
    """Takes down questions and right answers, where a judge would ask a port."""

    def __init__(self, arithmetic: Arithmetic, tier: Tier, seed: int):
        super().__init__(_NoPort(arithmetic), tier, seed, shrink=False)
        self._keys: set[bytes] = set()
        self._cases: list[StoredCase] = []
        self._undecided = 0

    def collect(self, name: str, test: Any) -> StoredTest:
        """The cases of one test."""
        self._cases, self._undecided = [], 0
        words = " ".join((test.__doc__ or "").split())
        try:
            for case in test.source.cases(self):
                for _ in test.property(self, case):
                    raise _PropertyError
        except _PropertyError:
            return StoredTest(name, words, None, 0)
        return StoredTest(name, words, self._cases, self._undecided)

    def agrees(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None = None) -> Talk:
        """Right is the reference's result in float64, within the bound."""
        self._take(stage, inputs, weights, exactly=False)
        yield from ()

    def agrees_exactly(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights) -> Talk:
        """Right are the same bits, but with Winograd."""
        self._take(stage, inputs, weights, exactly=not self.arithmetic.winograd)
        yield from ()

    def _take(self, stage: str, inputs: Mapping[str, NDArray[Any]], weights: Weights | None, *, exactly: bool) -> None:
        case = self.make_case(stage, inputs, weights)
        key = fingerprint([stage, dict(case.inputs), case.weights])
        expected = self.right(stage, inputs, weights)
        if key not in self._keys:
            self._keys.add(key)
            # Values read by a motion of the port's own choice have a right answer for each choice.
            if not expected or (stage == "occlusion_warp" and expected["occlusion_motion"].undecided):
                self._undecided += 1
            else:
                flushed = self.arithmetic.flushed
                exact = {name: Expected(right.want, flushed(right.want)) for name, right in expected.items()}
                self._cases.append(StoredCase(case, exact if exactly else expected))
