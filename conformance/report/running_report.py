# SPDX-License-Identifier: MIT
"""Report while ``stss conform`` runs: each failure is printed and stored when it occurs, and the JSON is whole at any moment."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from conformance.judging.findings import Failure, Finding, TestResult
from conformance.judging.judge import Judge
from conformance.options import ReportFiles
from conformance.report.failures import keep_failure
from conformance.report.junit import about_run, write_junit
from conformance.report.report import judged_on, passed, print_results, to_json, write_json, write_page
from conformance.suite.run_suite import OF_THE_RUN
from stss_ground.errors import InputError
from stss_ground.progress import Advance, show_progress
from stss_ground.shell import join_words
from stss_ground.terminal import Terminal, echo


class RunningReport:
    """Takes the results of a run one by one; a context, in which the progress is shown.

    Args:
        judge: judges the port.
        files: to write.
        again: the command that runs a failure again, without its folder.

    Attributes:
        results: of the tests so far.
        folders: of failures, by the id of the test.
    """

    def __init__(self, judge: Judge, files: ReportFiles, again: str):
        self.results: list[TestResult] = []
        self.folders: dict[str, Path] = {}
        self._judge, self._files, self._again = judge, files, again
        self._terminal = Terminal(stderr=True)
        self._bar = ExitStack()
        self._advance: Advance | None = None
        self._total = 0
        judge.tell = self._tell_early

    def __enter__(self) -> RunningReport:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def take(self, result: TestResult, total: int) -> None:
        """Take the next result; ``total`` is the number of tests in the run."""
        if self._advance is None:
            self._advance = self._bar.enter_context(show_progress(self._terminal, total, "tests"))
        self.results.append(result)
        self._total = total
        count = f"{self._count()} of {total} tests" if result.id not in OF_THE_RUN else "the run as a whole"
        self._advance(f"{result.id}: {result.outcome}")
        if result.outcome in ("failed", "error"):
            echo(f"{count}: {result.outcome}: {result.id}: {result.message}")
            for line in result.record.failure.finding.terms if result.record.failure is not None else ():
                echo(f"  {line}")
            if result.record.failure is not None:
                self._keep(result.id, result.record.failure)
        self.write()

    def _count(self) -> int:
        """The tests that ended; the results of the run as a whole are no tests."""
        return sum(result.id not in OF_THE_RUN for result in self.results)

    def _keep(self, name: str, failure: Failure) -> None:
        """Store a failure, and print how it is run again; where that cannot be, the run goes on all the same."""
        try:
            self.folders[name] = keep_failure(self._files.failures, name, failure, self._again)
        except InputError as error:
            echo(f"  not kept: {error}; --failures takes another folder")
        else:
            echo(f"  {self._again} --replay {join_words([str(self.folders[name])])}")

    def _tell_early(self, finding: Finding) -> None:
        """A failure that is still made smaller."""
        echo(f"fails; its case is being made smaller: {finding.message}")

    def finish(self) -> bool:
        """Print and write the whole report, even of a run that was stopped; whether the port passes."""
        complete = self._count() >= self._total > 0
        self.write(complete=complete)
        print_results(self.results, Terminal())
        if self._files.page is not None:
            write_page(self._files.page, self._judge, self.results, self.folders)
        if self._files.junit is not None:
            write_junit(self._files.junit, about_run(self._judge), self.results, self.folders)
        for line in judged_on(self._judge, self.results):
            echo(line)
        if not complete:
            echo(f"stopped after {self._count()} of {self._total} tests")
        return complete and passed(self.results)

    def write(self, *, complete: bool = False) -> None:
        """Write the JSON of the results so far; ``complete``: the run came to its end."""
        if self._files.json_file is not None:
            write_json(self._files.json_file, to_json(self._judge, self.results, self.folders, self._total, complete))
