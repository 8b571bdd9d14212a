# SPDX-License-Identifier: MIT
"""A certificate says what a port was judged on and how large its errors are; others can read it and run the judge again."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from conformance.findings import TestResult, tallied
from conformance.judge import Judge
from conformance.run_suite import SUITE
from stss.conform.report import by_stage, worst_of
from stss.conform.versions import versions_of_cases
from stss_ground.errors import InputError
from stss_ground.output.write_whole import write_named
from stss_ground.regular_file import read_json

FORMAT = 1
"""Version of the certificate; raised when a field changes its meaning."""
MOST_BYTES = 1 << 20


def refused(results: Sequence[TestResult], *, complete: bool) -> str:
    """Why a run gets no certificate; "" if it gets one.

    Args:
        results: of the tests of the run.
        complete: whether the run came to its end.
    """
    if not complete:
        return "the run was stopped"
    if known := sum(r.outcome == "known" for r in results):
        return f"{known} known failure{'s' if known > 1 else ''}"
    if failed := sum(r.outcome in ("failed", "error") for r in results):
        return f"{failed} test{'s' if failed > 1 else ''} failed"
    return ""


def certificate(judge: Judge, results: Sequence[TestResult]) -> dict[str, Any]:
    """The certificate of a port that conforms. It has no time or place, so a second run gives the same bytes, except for errors.

    Args:
        judge: judged the port; made with ``certified``.
        results: of all tests of the port; none failed.
    """
    judged = {
        stage: some
        for stage, each in by_stage(results).items()
        if stage in SUITE and (some := [r for r in each if r.outcome == "passed"])
    }
    stages = {stage: _stage(some) for stage, some in judged.items()}
    return {
        "format": FORMAT,
        "port": judge.port.name,
        "versions": versions_of_cases(),
        "dtype": judge.arithmetic.dtype,
        "winograd": judge.arithmetic.winograd,
        "tier": judge.tier.name,
        "seed": judge.seed,
        "repeat": judge.repeat,
        "cases": sum(stage["cases"] for stage in stages.values()),
        "cases_sha256": _digest([f"{name} {stage['cases_sha256']}" for name, stage in stages.items()]),
        "stages": stages,
        "not_judged": [stage for stage in SUITE if stage not in stages],
    }


def _stage(results: Sequence[TestResult]) -> dict[str, Any]:
    counted = tallied([r.record for r in results])
    sizes = [r.record.largest for r in results]
    return {
        "tests": len(results),
        "cases": counted["cases"],
        "cases_sha256": _digest([f"{r.id} {r.record.drawn.hex()}" for r in results]),
        "largest_height": max(height for height, _ in sizes),
        "largest_width": max(width for _, width in sizes),
        "undecided_numbers": counted["undecided"],
        "unjudged_cases": counted["unjudged"],
        "error_over_bound": {name: float(f"{ratio:.3g}") for name, ratio in worst_of(results).items()},
    }


def _digest(lines: Sequence[str]) -> str:
    return hashlib.sha256("".join(f"{line}\n" for line in lines).encode()).hexdigest()


def write_certificate(path: Path, judge: Judge, results: Sequence[TestResult]) -> str:
    """Write the certificate; returns the digest of its cases.

    Raises:
        InputError: the file cannot be written.
    """
    made = certificate(judge, results)
    write_named(path, json.dumps(made, indent=1) + "\n")
    return made["cases_sha256"]


def read_certificate(path: Path) -> dict[str, Any]:
    """Read a certificate, which anybody may have made.

    Raises:
        InputError: the file cannot be read, or is no certificate.
    """
    try:
        found = read_json(path, MOST_BYTES)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    try:
        well_formed = (
            found["format"] == FORMAT
            and isinstance(found["stages"], dict)
            and bool(found["stages"])
            and set(found["stages"]) <= set(SUITE)
            and found["dtype"] in ("float32", "float16")
            and found["tier"] in ("quick", "full")
            and re.fullmatch(r"[0-9.]{1,8}", found["versions"]["specification"]) is not None
        )
    except (LookupError, TypeError):
        well_formed = False
    if not well_formed:
        raise InputError(f"{path}: expected a certificate of stss conform, format {FORMAT}")
    return found
