# SPDX-License-Identifier: MIT
"""Run the suite: pytest with one plugin, which brings the judge and records the results."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conformance.judging.findings import DepartureError, Record, TestResult
from conformance.judging.judge import Judge
from conformance.judging.known_failures import KnownFailure, KnownFailuresError
from conformance.protocol.stages import STAGES
from conformance.suite.properties import find_property

SUITE_FOLDER = Path(__file__).parent
SEQUENCE = "sequence"
"""The tests of whole sequences, which need stage ``frame``."""
SUITE = (*STAGES, SEQUENCE)
_COLLECTING = "unraisableexception", "threadexception"
"""Plugins that collect garbage five times at the end of a run, a third of one short run's time; no port's exception is theirs."""
JUDGED = "suite.something_is_judged"
"""Id of the result that is added where nothing was: a run that says nothing of a port does not pass it."""
LARGE = "large_frames", "users_size"
"""Part of the names of tests of large frames."""
REQUIRED = "suite.required_stages_are_there"
"""Id of the result that is added where the port lacks one."""
ANSWERED = "suite.programs_answer_in_time"
"""Id of the result that is added where a program did not, and the rest of its stage was not judged."""
NOT_ASKED = "not judged: the program has not answered the stage's last cases in time"
OF_THE_RUN = JUDGED, REQUIRED, ANSWERED
"""Ids of the results that are of no test."""


def run_suite(
    judge: Judge,
    stages: Iterable[str] = SUITE,
    *,
    known_failures: Sequence[KnownFailure] = (),
    required_stages: Iterable[str] = (),
    first_only: bool = False,
    only: str = "",
    on_result: Callable[[TestResult, int], None] | None = None,
) -> list[TestResult]:
    """Run the properties of some stages.

    Args:
        judge: has the port.
        stages: names of ``SUITE``.
        known_failures: tests that may fail; those of other stages have no say.
        required_stages: stages that the port must have.
        first_only: stop at the first failure.
        only: the tests whose names hold this, as pytest's ``-k`` has it; "": all.
        on_result: called after every test with its result and the number of tests.

    Returns:
        One for each test, in the order of the stages, up to where it was interrupted; and a failure, ``JUDGED``, if none of them held
        anything against a bound, and ``REQUIRED``, if the port lacks a stage that it must have.

    Raises:
        KnownFailuresError: one of ``known_failures`` names no test.
        ValueError: no stages, or an unknown one.
    """
    stages = set(stages)
    if not stages or stages - set(SUITE):
        raise ValueError(f"stages: expected some of {', '.join(SUITE)}, got {', '.join(sorted(stages)) or 'none'}")
    require_known(known_failures)
    plugin = SuitePlugin(judge, known_failures, stages, required_stages, on_result, large_last=first_only)
    files = [str(SUITE_FOLDER / f"test_{stage}.py") for stage in SUITE if stage in stages]
    for file in files:
        assert Path(file).exists(), f"{file}: no tests of this stage; expected them there"
    own = ("-c", os.devnull, "--rootdir", str(SUITE_FOLDER), "--noconftest")
    arguments = [*files, *own, "--import-mode=importlib", "--capture=sys", "-W", "ignore"]
    arguments += [f"-pno:{name}" for name in ("cacheprovider", "terminal", "logging", "faulthandler", *_COLLECTING)]
    if only:
        arguments += ["-k", only]
    if first_only:
        arguments.append("--exitfirst")
    with _undisturbed():
        status = pytest.main(arguments, plugins=[plugin])
    if plugin.error is not None:
        raise plugin.error
    if status not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.INTERRUPTED) or plugin.fault:
        raise RuntimeError(plugin.fault or f"pytest ended with {status}")
    return plugin.results


def require_known(known_failures: Iterable[KnownFailure]) -> None:
    """Raise KnownFailuresError if one names no test."""
    for each in known_failures:
        try:
            find_property(each.test)
        except LookupError as error:
            raise KnownFailuresError(f"known failures: {error}") from error


@contextlib.contextmanager
def _undisturbed() -> Generator[None]:
    """The user's own pytest settings and plugins have no say, and pytest prints nothing.

    Hypothesis writes out the case that failed: whole weights would take longer than the stages that compute with them.
    """
    names = ("PYTEST_ADDOPTS", "PYTEST_PLUGINS", "PYTEST_DISABLE_PLUGIN_AUTOLOAD")
    values = {name: os.environ.pop(name, None) for name in names}
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    try:
        with contextlib.redirect_stdout(io.StringIO()), np.printoptions(threshold=0, edgeitems=1):
            yield
    finally:
        for name, value in values.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


class SuitePlugin:
    """A plugin that tells pytest the options and takes its results; arguments as of `run_suite`.

    Args:
        large_last: the large frames of all stages come last, since they take longest: for runs that end at the first failure.
    """

    def __init__(
        self,
        judge: Judge,
        known_failures: Sequence[KnownFailure],
        stages: set[str],
        required_stages: Iterable[str] = (),
        on_result: Callable[[TestResult, int], None] | None = None,
        *,
        large_last: bool = False,
    ):
        self._large_last = large_last
        self._judge, self._stages, self._required, self._on_result = judge, stages, set(required_stages), on_result
        self._known_failures = {each.test: each for each in known_failures}
        self._total = 0
        self._stdout = sys.stdout
        self._session: pytest.Session | None = None
        self.results: list[TestResult] = []
        self.judged_elsewhere = False
        """Whether another process of pytest-xdist judged something; the results are there."""
        self.fault = ""
        self.error: Exception | None = None
        """The error of `on_result`: through pytest it would be an internal error, with pytest's own traceback."""

    @property
    def has_judged(self) -> bool:
        """Whether an answer was compared with the right one."""
        return self.judged_elsewhere or any(_is_judged(result) for result in self.results)

    @pytest.fixture
    def judge(self, request: pytest.FixtureRequest) -> Judge:
        """The judge, at the beginning of a test; skips stages that the port lacks."""
        needs = stage_needed(_stage(request.node))
        if needs not in self._judge.stages:
            pytest.skip(f"the port has no stage {needs}")
        if self._judge.is_silent(needs):
            pytest.skip(NOT_ASKED)
        self._judge.begin()
        return self._judge

    def pytest_sessionstart(self, session: pytest.Session) -> None:
        """Remember the run, to end it."""
        self._session = session

    def pytest_configure(self, config: pytest.Config) -> None:
        """Tracebacks are plain text."""
        config.option.tbstyle = "native"  # pytest's own form parses every file on the way, for a text that is not shown

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Take down the errors of collecting."""
        if report.failed:
            self.fault = str(report.longrepr)

    @pytest.hookimpl(trylast=True)  # behind -k, which leaves some out
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Count the tests, and order them."""
        self._total = len(items)
        if self._large_last:
            items.sort(key=lambda item: any(word in item.name for word in LARGE))

    def pytest_sessionfinish(self) -> None:
        """Add results of the run as a whole."""
        lacks = {
            "the port has no stage": {each for each in self._required if stage_needed(each) not in self._judge.stages},
            "not among the stages that are judged:": self._required - self._stages,
        }
        if reasons := [f"{words} {', '.join(sorted(lacking))}" for words, lacking in lacks.items() if lacking]:
            words = "The port has the stages that it is required to have, and they are judged."
            self._add(REQUIRED, words, "; ".join(reasons))
        left = Counter(result.stage for result in self.results if result.message.endswith(NOT_ASKED))
        if left:
            words = ", ".join(f"{count} tests of stage {stage}" for stage, count in left.items())
            message = f"not judged: {words}: the program answered no case in time, several times in a row; see --timeout"
            self._add(ANSWERED, "A program answers in time.", message)
        if self.fault or len(self.results) < self._total or self.has_judged:
            return
        stages = sorted({result.stage for result in self.results} & set(SUITE), key=SUITE.index)
        lacks_all = all(result.outcome == "skipped" for result in self.results if result.id != REQUIRED)
        lacking = f"the port has none of the stages asked for: {', '.join(stages)}"
        message = f"nothing was judged: {lacking if lacks_all else 'rounding decided on every answer'}"
        self._add(JUDGED, "At least one answer of the port is compared with the right one.", message)

    def _add(self, name: str, words: str, message: str) -> None:
        """A failure of the run as a whole."""
        self._tell(TestResult(name, name.partition(".")[0], words, "failed", message))

    def _tell(self, result: TestResult) -> None:
        self.results.append(result)
        if self._on_result and self.error is None:
            try:
                with contextlib.redirect_stdout(self._stdout):
                    self._on_result(result, self._total)
            except Exception as error:
                self.error = error
                if self._session is not None:
                    self._session.shouldstop = "the report cannot be written"

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Take down a test's result; pytest is told of known failures, and shown the judge's message alone."""
        report = yield
        if call.when == "call" or report.skipped or report.failed:
            result = self._take(item, call, report)
            if result.outcome == "known":  # to pytest, which stops at a failure
                report.outcome, report.wasxfail = "skipped", result.message
            elif result.outcome == "failed":
                report.outcome, report.longrepr = "failed", result.message
        return report

    def _take(self, item: Any, call: pytest.CallInfo[None], report: pytest.TestReport) -> TestResult:
        stage, words = _stage(item), " ".join((item.function.__doc__ or "").split())
        name = f"{stage}.{item.name.removeprefix('test_')}"
        result = TestResult(name, stage, words, report.outcome, seconds=report.duration, record=self._judge.record)
        error = call.excinfo.value if call.excinfo is not None else None
        if report.skipped:
            result.message, result.record = str(error), Record()
        elif report.failed:
            if isinstance(error, DepartureError):
                result.message = str(error)
            else:
                result.outcome, result.message = "error", f"{type(error).__name__}: {error}"
            if result.id in self._known_failures:
                self._known_failures[result.id].excuse(result)
        elif result.id in self._known_failures:
            result.outcome, result.message = "failed", "it is among the known failures, and passes: take it off the list"
        self._tell(result)
        return result


def _is_judged(result: TestResult) -> bool:
    """Whether it says anything of the port: it failed, or something was held against a bound and found right."""
    return result.id not in (REQUIRED, JUDGED) and (result.outcome in ("failed", "error", "known") or bool(result.record.worst))


def _stage(item: Any) -> str:
    return item.path.stem.removeprefix("test_")


def stage_needed(name: str) -> str:
    """The stage that the tests of this name ask the port for."""
    return "frame" if name == SEQUENCE else name
