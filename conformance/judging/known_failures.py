# SPDX-License-Identifier: MIT
"""Known failures of a port: each has a reason, and a last day on which it is excused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from conformance.judging.findings import TestResult
from stss_ground.regular_file import read_json

MOST_BYTES = 1 << 20
FORMAT = 1
KEYS = ("test", "until", "reason")


class KnownFailuresError(ValueError):
    """A file of known failures is malformed, or names a test that does not exist."""


@dataclass(frozen=True)
class KnownFailure:
    """One test that is known to fail.

    Attributes:
        test: its id, ``stage.test``.
        until: the last day on which the failure is excused.
        reason: why, or a link.
    """

    test: str
    until: date
    reason: str

    def excuse(self, result: TestResult) -> None:
        """Mark a failed result as known; past its day it stays a failure, and its message says so."""
        if date.today() <= self.until:
            result.outcome = "known"
            result.message += f"; known until {self.until}: {self.reason}"
        else:
            result.message += f"; known until {self.until}, which is past: {self.reason}"


def read_known(path: Path) -> list[KnownFailure]:
    """The entries of a JSON file: ``{"format": 1, "failures": [{"test": ..., "until": "2026-12-31", "reason": ...}]}``.

    Raises:
        KnownFailuresError: it cannot be read, or an entry lacks something; the message names it.
    """
    try:
        data = read_json(path, MOST_BYTES)
    except OSError as error:
        raise KnownFailuresError(f"{path}: {error.strerror}") from error
    if not isinstance(data, dict) or set(data) != {"format", "failures"} or data["format"] != FORMAT:
        raise KnownFailuresError(f"{path}: expected format {FORMAT} and failures, and nothing else")
    entries = data["failures"]
    if not isinstance(entries, list):
        raise KnownFailuresError(f"{path}: failures: expected a list")
    failures = [_entry(f"{path}: failures[{i}]", entry) for i, entry in enumerate(entries)]
    names = [each.test for each in failures]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise KnownFailuresError(f"{path}: more than once: {', '.join(twice)[:200]}")
    return failures


def _entry(where: str, entry: Any) -> KnownFailure:
    if not isinstance(entry, Mapping):
        raise KnownFailuresError(f"{where}: expected test, until and reason")
    for key in KEYS:
        if not isinstance(entry.get(key), str) or not entry[key].strip():
            raise KnownFailuresError(f"{where}: {key}: expected words, got {str(entry.get(key, 'nothing'))[:80]!r}")
    if unknown := sorted(set(entry) - set(KEYS)):
        raise KnownFailuresError(f"{where}: expected {', '.join(KEYS)}, got {str(unknown[0])[:80]!r} as well")
    try:
        until = date.fromisoformat(entry["until"])
        if until.isoformat() != entry["until"]:
            raise ValueError(entry["until"])
    except ValueError as error:
        raise KnownFailuresError(f"{where}: until: expected a day like 2026-12-31, got {entry['until'][:80]!r}") from error
    return KnownFailure(entry["test"], until, entry["reason"])
