# SPDX-License-Identifier: MIT
"""Report the tables of `stss stress` on the terminal, as JSON, and in a page between its markers."""

from __future__ import annotations

import json
import math
import platform
import re
from pathlib import Path
from textwrap import fill
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table as RichTable

from stss.weights.file import identity
from stss_ground.errors import InputError
from stss_ground.machine import cpu_model, versions
from stss_ground.output.write_whole import write_named
from stss_ground.version import VERSION
from stss_lab.stress.measure import Results
from stss_lab.stress.table import Cell, StressTable, short

FORMAT = 1
"""Raised when a field of the JSON changes its meaning."""
PACKAGES = ("numpy", "pyopencl", "pocl-binary-distribution")
MARKER = re.compile(r"(<!-- stress: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


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
        "stss": VERSION,
        "machine": {
            "cpu": cpu_model(),
            "system": platform.system(),
            "architecture": platform.machine(),
            "device": results.device,
        },
        "packages": {"python": platform.python_version(), **versions(PACKAGES)},
        "plan": {"seeds": plan.seeds, "size": plan.size, "sizes": plan.sizes, "runs": plan.runs},
        "weights": None if plan.weights is None else identity(plan.weights),
        "tables": [_table(table) for table in results.tables],
    }
    return json.dumps(data, indent=1, allow_nan=False)


def _table(table: StressTable) -> dict[str, Any]:
    rows = [[_cell(cell) for cell in row] for row in table.rows]
    return {"key": table.key, "title": table.title, "columns": table.columns, "rows": rows, "axis": table.axis}


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


def read_page(path: Path) -> str:
    """Read the page that `write_page` updates.

    Raises:
        InputError: it can't be read, or has no marker ``<!-- stress: NAME -->`` ... ``<!-- end -->``.
    """
    try:
        page = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    if not MARKER.search(page):
        raise InputError(f"{path}: expected <!-- stress: NAME --> and <!-- end -->, found none")
    return page


def renew(page: str, results: Results) -> str:
    """``page`` with the measured tables between their markers; all other text and tables stay as they are."""

    def between(match: re.Match[str]) -> str:
        if match[2] == "measured":
            return f"{match[1]}{fill(measured_on(results), 100, break_on_hyphens=False)}\n{match[3]}"
        table = results.table(match[2])
        return match[0] if table is None else f"{match[1]}{markdown(table)}{match[3]}"

    return MARKER.sub(between, page)


def write_page(path: Path, results: Results) -> None:
    """Update the tables of the page ``path``; raises InputError as `read_page` does, or if the page can't be written."""
    write_named(path, renew(read_page(path), results))


def markdown(table: StressTable) -> str:
    """The title as a line, and the table."""
    head = f"| {' | '.join(table.columns)} |\n|{'---|' * len(table.columns)}\n"
    rows = "".join(f"| {' | '.join(map(text_of, row))} |\n" for row in table.rows)
    return f"*{table.title}*\n\n{head}{rows}"
