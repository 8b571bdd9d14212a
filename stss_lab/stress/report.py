# SPDX-License-Identifier: MIT
"""Report the tables of `stss stress` on the terminal and as JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table as RichTable

from stss.weights.file import identity
from stss_ground.machine import conditions, cpu_model, versions
from stss_ground.output.write_whole import write_named
from stss_ground.version import VERSION
from stss_lab.stress.measure import Results
from stss_lab.stress.table import Cell, StressTable, short

FORMAT = 2
"""Raised when a field of the JSON changes its meaning."""
PACKAGES = ("numpy", "pyopencl", "pocl-binary-distribution")


def text_of(cell: Cell) -> str:
    """A cell as a table shows it."""
    return cell if isinstance(cell, str) else short(cell)


def print_results(results: Results, console: Console) -> None:
    """One table after the other."""
    for table in results.tables:
        shown = RichTable(title=table.title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1))
        for i, column in enumerate(table.columns):
            shown.add_column(column, justify="right" if i else "left", no_wrap=i < 2, overflow="fold")
        for row in table.rows:
            shown.add_row(*map(text_of, row))
        console.print(shown)
    console.print(measured_on(results), soft_wrap=True, markup=False, highlight=False)


def measured_on(results: Results) -> str:
    """One sentence that names the versions, the seeds, the weights, the CPU and the device."""
    plan = results.plan
    packages = ", ".join(f"{name} {version}" for name, version in versions(PACKAGES).items())
    device = "the reference alone" if results.device is None else results.device
    weights = "random weights" if plan.weights is None else f"weights {identity(plan.weights)[:12]}"
    size = f"{plan.size[1]} x {plan.size[0]}"
    return f"stss {VERSION}, {plan.seeds} seeds, {weights}, frames of {size}; {cpu_model()}; {device}; {packages}."


def to_json(results: Results) -> str:
    """Every number and the conditions, as JSON; without names of hosts, users or folders."""
    plan = results.plan
    data = {
        "format": FORMAT,
        **conditions(PACKAGES),
        "device": results.device,
        "plan": {"seeds": plan.seeds, "size": plan.size, "sizes": plan.sizes},
        "weights": None if plan.weights is None else identity(plan.weights),
        "tables": [_table(table) for table in results.tables],
    }
    return json.dumps(data, indent=1, allow_nan=False)


def _table(table: StressTable) -> dict[str, Any]:
    rows = [[_cell(cell) for cell in row] for row in table.rows]
    return {"key": table.key, "title": table.title, "columns": table.columns, "rows": rows}


def _cell(cell: Cell) -> Any:
    if isinstance(cell, float) and not math.isfinite(cell):
        return "inf" if cell > 0 else None
    return cell


def write_json(path: Path, results: Results) -> None:
    """Write `to_json` to ``path``.

    Raises:
        InputError: it can't be written.
    """
    write_named(path, to_json(results) + "\n")
