# SPDX-License-Identifier: MIT
"""Print the tables of `stss stress`."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table as RichTable

from stss.weights.file import identity
from stss_ground.machine import cpu_model, versions
from stss_ground.version import VERSION
from stss_lab.stress.table import StressPlan, StressTable, short

PACKAGES = ("numpy", "pyopencl", "pocl-binary-distribution")


def print_tables(tables: Sequence[StressTable], plan: StressPlan, device: str | None, console: Console) -> None:
    """One table after the other, and the conditions; ``device``: name and driver, None without one."""
    for table in tables:
        rich_table = RichTable(title=table.title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1))
        for i, column in enumerate(table.columns):
            rich_table.add_column(column, justify="right" if i else "left", no_wrap=i < 2, overflow="fold")
        for row in table.rows:
            rich_table.add_row(*(cell if isinstance(cell, str) else short(cell) for cell in row))
        console.print(rich_table)
    packages = ", ".join(f"{name} {version}" for name, version in versions(PACKAGES).items())
    weights = "random weights" if plan.weights is None else f"weights {identity(plan.weights)[:12]}"
    conditions = (f"stss {VERSION}", f"{plan.seeds} seeds", weights, f"frames of {plan.size[1]} x {plan.size[0]}")
    machine = (cpu_model(), device or "the reference alone", packages)
    console.print(f"{', '.join(conditions)}; {'; '.join(machine)}.", soft_wrap=True, markup=False, highlight=False)
