# SPDX-License-Identifier: MIT
"""``stss conform --cluster``: workers run the tests; this process keeps their order, what fails, and the report."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Any

from conformance.findings import TestResult
from conformance.judge import Judge
from conformance.protocol.port import Arrays, Outputs, PortError
from conformance.run_suite import run_test
from stss.cluster.client import Crew, connected, crew, distributed
from stss.conform.load_port import Judging
from stss.conform.versions import versions_of_cases
from stss_ground.errors import InputError
from stss_ref.weights import Weights


@dataclass(frozen=True)
class PortIntroduction:
    """A worker's versions and what its port says of itself, or the reason why the worker cannot judge."""

    versions: dict[str, str | int]
    name: str = ""
    dtype: str = ""
    winograd: bool = False
    stages: frozenset[str] = frozenset()
    error: str = ""


class JudgingWorker:
    """One run on one worker. Tests come one at a time, whatever number of threads the worker has."""

    def __init__(self, judging: Judging):
        self._judging = judging
        self._lock = Lock()
        self._judge: Judge | None = None

    def introduce(self) -> PortIntroduction:
        """Open the port; returns what it says of itself, or why it cannot be opened."""
        try:
            with self._lock:
                judge = self._opened()
        except (InputError, PortError) as error:
            return PortIntroduction(versions_of_cases(), error=str(error))
        given = judge.arithmetic
        return PortIntroduction(versions_of_cases(), judge.port.name, given.dtype, given.winograd, judge.stages)

    def test(self, name: str) -> TestResult:
        """Run one test, ``stage.test``."""
        with self._lock:
            return run_test(self._opened(), name)

    def _opened(self) -> Judge:
        if self._judge is None:
            self._judge = self._judging.judge()
        return self._judge


class PortElsewhere:
    """Stands for the workers' port in the process that reports: it says what they say of it, and computes nothing."""

    def __init__(self, found: PortIntroduction):
        self.name, self.dtype, self.winograd = found.name, found.dtype, found.winograd
        self._stages = found.stages

    def stages(self) -> frozenset[str]:
        """The workers'."""
        return self._stages

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """Never asked for."""
        raise PortError(f"stage {stage}: computed by workers alone")


class TestsElsewhere:
    """See ``conformance.run_suite.Elsewhere``; a test whose worker dies is run again by another worker or by its successor."""

    __test__ = False  # to pytest: none of its classes

    def __init__(self, workers: Crew):
        self._workers = workers
        self._futures: dict[str, Any] = {}

    def begin(self, tests: Sequence[str]) -> None:
        """Hand all tests to the workers."""
        self._futures = {test: self._workers.submit("test", test) for test in tests}

    def result(self, test: str) -> TestResult:
        """Wait for a test; where it ends each worker that runs it, that is an error of the test."""
        future = self._futures.pop(test)
        while True:
            self._workers.require_some()
            with suppress(distributed().TimeoutError):
                distributed().wait([future], timeout=1)
                break
        try:
            return future.result()
        except distributed().KilledWorker as error:
            message = f"every worker that ran it ended, {error.last_worker.address} last"
            return TestResult(test, test.partition(".")[0], "", "error", message)


@contextmanager
def judged_on_cluster(address: str, judging: Judging) -> Generator[tuple[Judge, TestsElsewhere], None, None]:
    """Give the workers of an address a port to judge.

    Args:
        address: see ``stss.cluster.client.connected``.
        judging: what they judge, and how.

    Yields:
        What ``conformance.run_suite.run_suite`` takes: a judge that knows what the port says of itself, and ``elsewhere``.

    Raises:
        InputError: nothing answers at the address, a worker cannot open the port, or workers or their ports differ.
    """
    with connected(address) as client, crew(client, partial(JudgingWorker, judging)) as workers:
        port = PortElsewhere(_agreed(workers.introductions()))
        yield Judge(port, judging.tier, judging.seed, repeat=judging.repeat, certified=judging.certified), TestsElsewhere(workers)


def _agreed(found: dict[str, PortIntroduction]) -> PortIntroduction:
    here = versions_of_cases()
    for address, who in found.items():
        if who.error:
            raise InputError(f"worker {address}: {who.error}")
        for package, version in who.versions.items():
            if version != here[package]:
                raise InputError(f"worker {address}: expected {package} {here[package]}, as here, found {version}: other cases")
    first, *others = found.values()
    for name in ("name", "dtype", "winograd", "stages"):
        if any(getattr(who, name) != getattr(first, name) for who in others):
            said = "; ".join(sorted({_said(getattr(who, name)) for who in found.values()}))
            raise InputError(f"--cluster: workers' ports differ: {name}: {said}")
    return first


def _said(value: str | bool | frozenset[str]) -> str:
    return ", ".join(sorted(value)) if isinstance(value, frozenset) else str(value)
