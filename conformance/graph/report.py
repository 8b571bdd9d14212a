# SPDX-License-Identifier: MIT
"""Report the findings about a network's port: a table, JSON, JUnit XML, a page."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from conformance.graph.model import Model
from conformance.graph.ports import GraphPort
from conformance.graph.run import Outcome, Tensor
from conformance.judging.findings import Record, TestResult
from conformance.options import ReportFiles
from conformance.report.junit import write_junit
from conformance.report.markup import failure_of, number_of, row_of, table_of
from conformance.report.report import write_json
from stss_ground.output.write_whole import write_named
from stss_ground.pages.page import page
from stss_ground.terminal import printable
from stss_ground.version import VERSION

FORMAT = 1
MOST_ROWS = 8
"""Most tensors of the printed table: those nearest to their bounds."""
HEAD = ("tensor", "operator", "cases", "error / bound", "rms / bound")
TENSORS, OUTPUTS = "tensors", "outputs"
"""Tests of tensors, each from the port's own before it, and of the outputs, from the inputs."""


def print_outcome(outcome: Outcome, console: Console) -> None:
    """Print the tensors nearest to their bounds, the outputs, and the faults."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in HEAD:
        table.add_column(name, justify="left" if name in HEAD[:2] else "right", overflow="fold")
    nearest = sorted(outcome.tensors.items(), key=lambda each: -each[1].ratio)[:MOST_ROWS]
    ends = {f"output {name}, from the inputs": tensor for name, tensor in outcome.ends.items()}
    for name, tensor in (*nearest, *ends.items()):
        table.add_row(printable(name), tensor.op, str(tensor.cases), number_of(tensor.ratio), number_of(tensor.rms))
    console.print(table)
    for line in lines_of(outcome):
        console.print(printable(line), soft_wrap=True, markup=False, highlight=False)


def lines_of(outcome: Outcome) -> list[str]:
    """The lines besides the numbers."""
    unsuited = f"; {outcome.unsuited} drawn sizes do not suit the model" if outcome.unsuited else ""
    more = [f"{outcome.cases} cases, {len(outcome.tensors)} tensors judged{unsuited}"]
    dependent = [name for name, tensor in outcome.tensors.items() if not tensor.is_own]
    if dependent:
        more.append(
            f"{len(dependent)} tensors, such as {dependent[0]}, depend on tensors that the port did not return: "
            "their bounds are estimates from random changes, about 100 times the rounding"
        )
    if fused := [name for name, tensor in outcome.tensors.items() if tensor.fused]:
        more.append(
            f"{len(fused)} tensors, such as {fused[0]}, are right together with nodes before them: the port computes these at once"
        )
    more += [f"not judged: {line}" for line in outcome.unknown]
    more += [f"not judged: output {name}" for name in outcome.unjudged]
    return [*more, *outcome.wrong]


def write_files(
    outcome: Outcome, model: Model, port: GraphPort, options: Mapping[str, Any], folder: Path | None, files: ReportFiles
) -> None:
    """Write the files that are wanted.

    Args:
        outcome: of the run.
        model: the network.
        port: that was judged.
        options: of the run.
        folder: of the failure; None: there is none.
        files: to write.

    Raises:
        InputError: a file cannot be written.
    """
    results = _results(outcome)
    folders = {result.id: folder for result in results if folder is not None and result.outcome == "failed"}
    if files.json_file is not None:
        write_json(files.json_file, to_json(outcome, model, port, options, folder))
    if files.junit is not None:
        about = {"stss": VERSION, "model": printable(model.path.name), "port": printable(port.name), **options}
        write_junit(files.junit, about, results, folders)
    if files.page is not None:
        title = f"{port.name} {'passes' if outcome.passes else 'departs'}: {model.path.name}"
        _write_page(files.page, title, outcome, results, folder)


def to_json(outcome: Outcome, model: Model, port: GraphPort, options: Mapping[str, Any], folder: Path | None) -> dict[str, Any]:
    """All results as an object (conformance/report/schemas/graph-results.schema.json)."""

    def rows(tensors: Mapping[str, Tensor]) -> list[dict[str, Any]]:
        return [
            {
                "tensor": name, "operator": tensor.op, "cases": tensor.cases, "introduced": tensor.is_own,
                "error_over_bound": tensor.ratio if math.isfinite(tensor.ratio) else None,
                "rms_over_bound": tensor.rms if math.isfinite(tensor.rms) else None,
            }
            for name, tensor in tensors.items()
        ]  # fmt: skip

    return {
        "format": FORMAT, "stss": VERSION, "model": model.path.name, "port": printable(port.name), **options,
        "passed": outcome.passes, "cases": outcome.cases, "tensors": rows(outcome.tensors), "outputs": rows(outcome.ends),
        "unknown": [*outcome.unknown], "wrong": [*outcome.wrong], "failure": None if folder is None else str(folder),
    }  # fmt: skip


def _results(outcome: Outcome) -> list[TestResult]:
    """A test for each tensor and each output; one more where the port failed."""

    def test(kind: str, name: str, tensor: Tensor) -> TestResult:
        record = Record(tensor.cases, worst={f"{name}.error": tensor.ratio, f"{name}.rms": tensor.rms})
        outcome_of_tensor = ("passed", "") if tensor.ratio <= 1 else ("failed", f"error / bound {number_of(tensor.ratio)}")
        return TestResult(printable(name), kind, tensor.op, *outcome_of_tensor, record=record)

    results = [test(TENSORS, *each) for each in outcome.tensors.items()]
    results += [test(OUTPUTS, f"output {name}", tensor) for name, tensor in outcome.ends.items()]
    if outcome.wrong and all(each.outcome == "passed" for each in results):
        results.append(TestResult("run", "port", "it answers", "failed", outcome.wrong[0], record=Record(outcome.cases)))
    return results


def _write_page(path: Path, title: str, outcome: Outcome, results: list[TestResult], folder: Path | None) -> None:
    lines = "".join(f"<p>{html.escape(printable(line))}</p>" for line in lines_of(outcome))
    failure = next((failure_of(each, folder) for each in results if each.outcome == "failed"), "")
    rows = "".join(map(row_of, results))
    table = table_of("Tensors", ("tensor", "operator", "outcome"), ("cases", "error / bound"), rows, stack=True)
    write_named(path, page(title, f"<h1>{html.escape(printable(title))}</h1>{lines}{failure}{table}"))
