# SPDX-License-Identifier: MIT
"""What was found of a network's port: a table, JSON, JUnit XML, a page."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from rich import box
from rich.console import Console
from rich.table import Table

from conformance.graph.model import Model
from conformance.graph.ports import GraphPort
from conformance.graph.run import Outcome, Tensor
from stss_ground.output.write_whole import write_named
from stss_ground.pages.page import page
from stss_ground.terminal import printable
from stss_ground.version import VERSION

FORMAT = 1
SHOWN = 8
"""Most tensors of the printed table: those nearest to their bounds."""
HEAD = ("tensor", "operator", "cases", "error / bound", "rms / bound")


def print_outcome(outcome: Outcome, console: Console) -> None:
    """Print the tensors nearest to their bounds, the outputs, and what is wrong."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in HEAD:
        table.add_column(name, justify="left" if name in HEAD[:2] else "right", overflow="fold")
    nearest = sorted(outcome.tensors.items(), key=lambda each: -each[1].ratio)[:SHOWN]
    for name, tensor in nearest:
        table.add_row(printable(name), *_cells(tensor))
    for name, tensor in outcome.ends.items():
        table.add_row(f"output {printable(name)}, from the inputs", *_cells(tensor))
    console.print(table)
    for line in lines_of(outcome):
        console.print(printable(line), soft_wrap=True, markup=False, highlight=False)


def lines_of(outcome: Outcome) -> list[str]:
    """What is to be said besides the numbers."""
    unsuited = f"; {outcome.unsuited} drawn sizes do not suit the model" if outcome.unsuited else ""
    more = [f"{outcome.cases} cases, {len(outcome.tensors)} tensors judged{unsuited}"]
    derived = [name for name, tensor in outcome.tensors.items() if not tensor.is_own]
    if derived:
        more.append(
            f"{len(derived)} tensors are made of some that were not handed over, such as {derived[0]}: "
            "their bounds are estimates from random changes, some 100 times what rounding does"
        )
    if fused := [name for name, tensor in outcome.tensors.items() if tensor.fused]:
        more.append(
            f"{len(fused)} tensors, such as {fused[0]}, are right together with nodes before them: the port computes these at once"
        )
    more += [f"not judged: {line}" for line in outcome.unknown]
    return [*more, *outcome.wrong]


def _cells(tensor: Tensor) -> tuple[str, ...]:
    return tensor.op, str(tensor.cases), _number(tensor.ratio), _number(tensor.rms)


def _number(x: float) -> str:
    return f"{x:.2g}" if math.isfinite(x) else "wrong"


def to_json(outcome: Outcome, model: Model, port: GraphPort, options: Mapping[str, Any]) -> dict[str, Any]:
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
        "unknown": [*outcome.unknown], "wrong": [*outcome.wrong],
    }  # fmt: skip


def write_json(path: Path, found: Mapping[str, Any]) -> None:
    """Write `to_json`; InputError if the file cannot be written."""
    write_named(path, json.dumps(found, indent=1) + "\n")


def write_junit(path: Path, outcome: Outcome, port: GraphPort) -> None:
    """Write JUnit XML, a test for each tensor; InputError if the file cannot be written."""
    root = ElementTree.Element("testsuites", name=f"stss conform --onnx: {printable(port.name)}")
    tests = {**outcome.tensors, **{f"output {name}": tensor for name, tensor in outcome.ends.items()}}
    wrong = {name for name, tensor in tests.items() if not tensor.ratio <= 1}
    if outcome.wrong and not wrong:
        tests, wrong = {**tests, "run": Tensor("", math.inf)}, {"run"}
    suite = ElementTree.SubElement(root, "testsuite", name="tensors", tests=str(len(tests)), failures=str(len(wrong)))
    for name, tensor in tests.items():
        case = ElementTree.SubElement(suite, "testcase", classname=tensor.op or "port", name=printable(name))
        if name in wrong:
            failure = ElementTree.SubElement(case, "failure", message=f"error / bound {_number(tensor.ratio)}")
            failure.text = "\n".join(map(printable, outcome.wrong))
    write_named(path, ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n")


def write_page(path: Path, outcome: Outcome, model: Model, port: GraphPort) -> None:
    """Write one HTML file; InputError if the file cannot be written."""
    verdict = "passes" if outcome.passes else "departs"
    rows = "".join(
        "<tr>" + "".join(f"<td>{html.escape(printable(cell))}" for cell in (name, *_cells(tensor)))
        for name, tensor in [*outcome.tensors.items(), *((f"output {n}", t) for n, t in outcome.ends.items())]
    )
    said = "".join(f"<p>{html.escape(printable(line))}</p>" for line in lines_of(outcome))
    head = "".join(f'<th scope="col">{name}' for name in HEAD)
    body = (
        f"<h1>{html.escape(printable(port.name))} {verdict}: {html.escape(model.path.name)}</h1>{said}"
        '<div class="scroll" tabindex="0" role="region" aria-label="Tensors">'
        f"<table><thead><tr>{head}</thead><tbody>{rows}</tbody></table></div>"
    )
    write_named(path, page(f"{port.name}: {model.path.name}", body))
