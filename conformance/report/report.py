# SPDX-License-Identifier: MIT
"""The report of ``stss conform``: a table, JSON and a page."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from conformance.cases.large_inputs import USER_SIZES, user_sizes
from conformance.judging.findings import TestResult, tally
from conformance.judging.judge import TIERS, Judge
from conformance.protocol.stages import STAGES
from conformance.protocol.weights_format import VERSIONS
from conformance.report.markup import failure_of, number_of, row_of, table_of
from conformance.report.versions import versions_of_cases
from conformance.suite.run_suite import JUDGED, OF_THE_RUN, SEQUENCE, SUITE
from stss_ground.output.write_whole import write_named
from stss_ground.pages.page import page
from stss_ground.terminal import printable
from stss_ground.version import VERSION

FORMAT = 1
"""Version of the JSON; raised when a field changes its meaning."""
OUTPUT_STAGE = {SEQUENCE: "frame"}
"""Tests that are of no stage -> the stage whose outputs they judge."""


def print_results(results: Sequence[TestResult], console: Console) -> None:
    """Print a line for each stage, then the known failures."""
    table = Table(box=box.SIMPLE_HEAD, padding=0)
    for name, justify in (
        ("stage", "left"),
        ("tests", "right"),
        ("failed", "right"),
        ("cases", "right"),
        ("error / bound", "left"),
    ):
        table.add_column(name, justify=justify, no_wrap=name != "error / bound")
    for stage, some in by_stage([r for r in results if r.id not in OF_THE_RUN]).items():
        if all(r.outcome == "skipped" for r in some):
            table.add_row(stage, str(len(some)), "-", "-", "the port lacks it")
            continue
        bad = sum(r.outcome in ("failed", "error") for r in some)
        met = worst_of(some)
        worst = ", ".join(
            [*(f"{name.split('.')[-1]} {number_of(ratio)}" for name, ratio in met.items()),
             *(f"{name} not judged" for name in _outputs(stage) if f"{OUTPUT_STAGE.get(stage, stage)}.{name}" not in met)]
        )  # fmt: skip
        counts = tally([r.record for r in some])
        note = f"; {counts['undecided']} numbers decided by rounding" if counts["undecided"] else ""
        note += f"; {counts['unjudged']} cases not judged" if counts["unjudged"] else ""
        table.add_row(stage, str(len(some)), str(bad or "-"), str(counts["cases"]), worst + note)
    console.print(table)
    for result in results:
        if result.outcome == "known":
            console.print(f"{result.outcome}: {result.id}: {result.message}", soft_wrap=True, markup=False, highlight=False)


def _outputs(stage: str) -> list[str]:
    return list(STAGES[OUTPUT_STAGE.get(stage, stage)].outputs)


def by_stage(results: Sequence[TestResult]) -> dict[str, list[TestResult]]:
    """Stage -> its results, in the order of the run."""
    groups: dict[str, list[TestResult]] = {}
    for result in results:
        groups.setdefault(result.stage, []).append(result)
    return groups


def worst_of(results: Sequence[TestResult]) -> dict[str, float]:
    """``stage.output`` -> its largest error / bound."""
    worst: dict[str, float] = {}
    for result in results:
        for name, ratio in result.record.worst.items():
            worst[name] = max(ratio, worst.get(name, 0.0))
    return worst


def to_json(
    judge: Judge, results: Sequence[TestResult], folders: dict[str, Path], total: int, complete: bool = True
) -> dict[str, Any]:
    """All results, for another program. The ratio of a wrong mask, which is infinite, is null.

    Args:
        judge: judged the port.
        results: of the tests so far.
        folders: of failures, by the id of the test.
        total: number of tests in the run.
        complete: whether the run came to its end.
    """
    return {
        "format": FORMAT,
        "versions": versions_of_cases(),
        "port": judge.port.name,
        "dtype": judge.arithmetic.dtype,
        "winograd": judge.arithmetic.winograd,
        "weights_version": judge.weights_version,
        "largest_side": judge.largest_side,
        "tier": judge.tier.name,
        "seed": judge.seed,
        "repeat": judge.repeat,
        "complete": complete,
        "tests_in_all": total,
        "passed": complete and passed(results),
        "judged": JUDGED not in {r.id for r in results},
        "stages": {stage: _stage(some) for stage, some in judged_by_stage(results).items()},
        "not_judged": [stage for stage in SUITE if stage not in judged_by_stage(results)],
        "tests": [
            {
                "id": r.id,
                "stage": r.stage,
                "property": r.property,
                "outcome": r.outcome,
                "message": r.message,
                "seconds": round(r.seconds, 3),
                "cases": r.record.cases,
                "undecided": r.record.undecided,
                "unjudged": r.record.unjudged,
                "error_over_bound": {name: ratio if math.isfinite(ratio) else None for name, ratio in r.record.worst.items()},
                "failure": str(folders[r.id]) if r.id in folders else None,
            }
            for r in results
        ],
    }


def judged_by_stage(results: Sequence[TestResult]) -> dict[str, list[TestResult]]:
    """Stage -> the results of its tests that ran, without the stages that the port lacks."""
    ran = [r for r in results if r.stage in SUITE and r.outcome != "skipped"]
    return by_stage(ran)


def judged_on(judge: Judge, results: Sequence[TestResult]) -> list[str]:
    """The last lines of a report: the largest sizes, and the inputs that the port does not take."""
    sizes: dict[tuple[int, int], list[str]] = {}
    for stage, some in judged_by_stage(results).items():
        largest = max(r.record.largest[0] for r in some), max(r.record.largest[1] for r in some)
        if max(largest):
            sizes.setdefault(largest, []).append(stage)
    lines = [f"largest height {height}, largest width {width}: {', '.join(names)}" for (height, width), names in sizes.items()]
    return [*lines, *_list_refused(judge), *_left_to_full(judge, [stage for some in sizes.values() for stage in some])]


def _left_to_full(judge: Judge, stages: Sequence[str]) -> list[str]:
    """The stages that only a larger tier judges, and the option that asks for it."""
    side = judge.largest_side
    smaller = [
        stage
        for stage in STAGES
        if stage in stages and user_sizes(stage, judge.tier.large, side) != user_sizes(stage, TIERS["full"].large, side)
    ]
    height, width = USER_SIZES["full"]
    return [f"not judged at {height} x {width}, as --tier full does: {', '.join(smaller)}"] if smaller else []


def _list_refused(judge: Judge) -> list[str]:
    """The inputs that the port does not take, in words."""
    version = judge.weights_version
    old = [f"weights up to version {version} only, as the port declares"] if version != max(VERSIONS) else []
    narrow = [f"no array of more than {judge.largest_side} rows or columns, as the port declares"] if judge.largest_side else []
    return old + narrow


def _stage(results: Sequence[TestResult]) -> dict[str, Any]:
    """The cases that a stage was judged on."""
    counts = tally([r.record for r in results])
    return {
        "tests": len(results),
        "cases": counts["cases"],
        "largest_height": max(r.record.largest[0] for r in results),
        "largest_width": max(r.record.largest[1] for r in results),
        "undecided": counts["undecided"],
        "unjudged": counts["unjudged"],
        "error_over_bound": {name: ratio if math.isfinite(ratio) else None for name, ratio in worst_of(results).items()},
    }


def passed(results: Sequence[TestResult]) -> bool:
    """Whether something was judged, and nothing failed except known failures."""
    return all(r.outcome in ("passed", "skipped", "known") for r in results)


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write the object that `to_json` returns.

    Raises:
        InputError: the file cannot be written.
    """
    write_named(path, json.dumps(data, indent=1) + "\n")


def write_page(path: Path, judge: Judge, results: Sequence[TestResult], folders: dict[str, Path]) -> None:
    """Write a single HTML file, which has its pictures inside.

    Args:
        path: to write.
        judge: judged the port.
        results: of the tests.
        folders: of failures, by the id of the test.

    Raises:
        InputError: the file cannot be written.
    """
    arithmetic = judge.arithmetic.dtype + (", Winograd" if judge.arithmetic.winograd else "")
    arithmetic = "; ".join([arithmetic, *_list_refused(judge)])
    counts = tally([r.record for r in results])
    verdict = "passes" if passed(results) else "departs from the specification"
    verdict = "was not judged" if JUDGED in {r.id for r in results} else verdict
    rows = "".join(row_of(r) for r in results)
    outputs = "".join(_stage_row(stage, some) for stage, some in by_stage([r for r in results if r.stage in SUITE]).items())
    failures = "".join(failure_of(r, folders.get(r.id)) for r in results if r.outcome in ("failed", "error"))
    bad = [r.id for r in results if r.outcome in ("failed", "error")]
    links = ", ".join(f'<a href="#{html.escape(name)}"><code>{html.escape(name)}</code></a>' for name in bad)
    tests = [r for r in results if r.id not in OF_THE_RUN]
    failed = f"{sum(r.id in bad for r in tests)} of {len(tests)} tests"
    summary = f"<p>{failed} failed: {links}</p>" if bad else ""
    body = f"""<h1>{html.escape(printable(judge.port.name))} {verdict}</h1>
<p>{arithmetic}; tier {judge.tier.name}, seed {judge.seed}; {counts["cases"]} cases; {counts["undecided"]} numbers decided by rounding,
{counts["unjudged"]} cases not judged for that; stss {VERSION}.</p>
{summary}
{table_of("Outputs", ("stage", "output"), ("largest error / bound",), outputs)}
{failures}
{table_of("Tests", ("test", "what it asks", "outcome"), ("cases", "error / bound"), rows, stack=True)}"""
    write_named(path, page(f"{judge.port.name}: conformance", body))


def _stage_row(stage: str, some: Sequence[TestResult]) -> str:
    """A row for each output: its largest error / bound, or that it was not judged."""
    worst = worst_of(some)
    ratios = {name.split(".")[-1]: f'<td class="n">{number_of(ratio)}' for name, ratio in worst.items()}
    why = ": the port lacks the stage" if all(r.outcome == "skipped" for r in some) else ""
    lacking = f'<td class="n wrap">not judged{why}'
    outputs = dict.fromkeys([*_outputs(stage), *ratios])
    return "".join(f"<tr><td><code>{stage}</code><td>{html.escape(name)}{ratios.get(name, lacking)}</tr>" for name in outputs)
