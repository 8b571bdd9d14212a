# SPDX-License-Identifier: MIT
"""What ``stss conform`` leaves while it runs: each failure is told and kept when it occurs, and the JSON is whole at any moment."""

from __future__ import annotations

import shlex
from pathlib import Path

from conformance.findings import TestResult
from conformance.judge import Judge
from stss.conform.certificate import refused, write_certificate
from stss.conform.failures import keep_failure
from stss.conform.report import passed, print_results, to_json, write_json, write_page
from stss.terminal import Terminal, echo


class RunningReport:
    """Takes the results one by one.

    Args:
        judge: that judges.
        failures: folder for what fails.
        again: the command that runs a failure again, but for its folder.
        json_file: for every result; None: none.

    Attributes:
        results: so far.
        folders: of what failed, by the id of the test.
    """

    def __init__(self, judge: Judge, failures: Path, again: str, json_file: Path | None = None):
        self.results: list[TestResult] = []
        self.folders: dict[str, Path] = {}
        self._judge, self._failures, self._again, self._json = judge, failures, again, json_file
        self._terminal = Terminal(stderr=True)
        self._status = self._terminal.status("")
        self._total = 0

    def __enter__(self) -> RunningReport:
        self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._status.stop()

    def take(self, result: TestResult, total: int) -> None:
        """One more, of so many."""
        self.results.append(result)
        self._total = total
        done = f"{len(self.results)} of {total} tests"
        self._status.update(f"{done}: {result.id}: {result.outcome}")
        if result.outcome in ("failed", "error"):
            echo(f"{done}: {result.outcome}: {result.id}: {result.message}")
            for line in result.record.failure.finding.terms if result.record.failure is not None else ():
                echo(f"  {line}")
            if result.record.failure is not None:
                self.folders[result.id] = keep_failure(self._failures, result.id, result.record.failure, self._again)
                echo(f"  {self._again} --replay {shlex.quote(str(self.folders[result.id]))}")
        self.write()

    def finish(self, page: Path | None) -> bool:
        """All there is to tell, if the run came to its end or not; whether the port passes."""
        complete = self._complete()
        self.write(complete=complete)
        print_results(self.results, Terminal())
        if page is not None:
            write_page(page, self._judge, self.results, self.folders)
        if not complete:
            echo(f"stopped after {len(self.results)} of {self._total} tests")
        return complete and passed(self.results)

    def certify(self, path: Path) -> bool:
        """Write the certificate, or say why there is none."""
        if why := refused(self.results, complete=self._complete()):
            echo(f"no certificate: {why}")
            return False
        echo(f"{path}: cases {write_certificate(path, self._judge, self.results)[:16]}")
        return True

    def _complete(self) -> bool:
        return len(self.results) >= self._total > 0

    def write(self, *, complete: bool = False) -> None:
        """The JSON of what there is."""
        if self._json is not None:
            write_json(self._json, to_json(self._judge, self.results, self.folders, self._total, complete))
