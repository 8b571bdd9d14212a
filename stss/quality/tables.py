# SPDX-License-Identifier: MIT
"""Printing of tables."""

from __future__ import annotations

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table


def print_whole(table: Table, console: Console) -> None:
    """Print a table at its full width even on a narrower console: a cut number is worse than a broken line."""
    console.width = max(console.width, Measurement.get(console, console.options.update(max_width=1000), table).maximum)
    console.print(table)
