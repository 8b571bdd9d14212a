# SPDX-License-Identifier: MIT
"""``stss conform --junit``: the results in the form that CI systems show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

from conformance.judging.findings import TestResult
from conformance.judging.judge import Judge
from conformance.report.report import by_stage
from conformance.report.versions import versions_of_cases
from stss_ground.output.write_whole import write_named
from stss_ground.terminal import printable


def about_run(judge: Judge) -> dict[str, str | int]:
    """The options of a run, which are properties of each suite."""
    return {
        **versions_of_cases(), "port": printable(judge.port.name), "dtype": judge.arithmetic.dtype, "tier": judge.tier.name,
        "seed": judge.seed, "repeat": judge.repeat, "winograd": judge.arithmetic.winograd, "weights_version": judge.weights_version,
        "largest_side": judge.largest_side or "any",
    }  # fmt: skip


def write_junit(path: Path, about: Mapping[str, str | int], results: Sequence[TestResult], folders: Mapping[str, Path]) -> None:
    """Write JUnit XML: a suite for each stage, tests by the ids that a list of known failures takes.

    Args:
        path: to write.
        about: properties of each suite, such as `about_run`; its ``port`` is a part of the name.
        results: of the tests so far.
        folders: of failures, by the id of the test: their texts, with the worst pixel and the command that runs them again, are the bodies.

    Raises:
        InputError: the file cannot be written.
    """
    root = ElementTree.Element("testsuites", name=f"stss conform: {about['port']}")
    for stage, some in by_stage(results).items():
        counts = {
            "tests": len(some), "failures": _count(some, "failed"), "errors": _count(some, "error"),
            "skipped": _count(some, "skipped") + _count(some, "known"), "time": f"{sum(r.seconds for r in some):.3f}",
        }  # fmt: skip
        suite = ElementTree.SubElement(root, "testsuite", {"name": stage, **{name: str(count) for name, count in counts.items()}})
        properties = ElementTree.SubElement(suite, "properties")
        for name, value in about.items():
            ElementTree.SubElement(properties, "property", name=name, value=str(value))
        for result in some:
            _add(suite, result, folders.get(result.id))
    write_named(path, ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n")


def _count(results: Sequence[TestResult], outcome: str) -> int:
    return sum(r.outcome == outcome for r in results)


def _add(suite: ElementTree.Element, result: TestResult, folder: Path | None) -> None:
    case = ElementTree.SubElement(
        suite, "testcase", classname=result.stage, name=printable(result.id), time=f"{result.seconds:.3f}"
    )
    message = printable(result.message)
    if result.outcome in ("skipped", "known"):
        ElementTree.SubElement(case, "skipped", message=message)
    elif result.outcome != "passed":
        failure = ElementTree.SubElement(case, "error" if result.outcome == "error" else "failure", message=message)
        lines = [message] if folder is None else (folder / "README.txt").read_text(encoding="utf-8").splitlines()
        failure.text = "\n".join(map(printable, lines))
