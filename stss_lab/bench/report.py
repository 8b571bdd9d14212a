# SPDX-License-Identifier: MIT
"""Report the benchmark's results as a table and as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from stss_ground.machine import conditions
from stss_lab.bench.measure import PAUSE, SUMMARY, WARM_UP, SizeResult, Timing
from stss_lab.bench.peers import PEERS

FORMAT = 3
"""Version of the JSON; raised when a field changes its meaning."""
PACKAGES = ("numpy", "pyopencl", "pocl-binary-distribution", "torch", "onnx", "onnxruntime", "openvino")


def print_results(results: Sequence[SizeResult], console: Console) -> None:
    """Print a table for each size, with a contender's stages below it if it measures them."""
    for result in results:
        console.print(_table(result))
        for row in result.rows:
            if row.fault:
                console.print(f"{row.name}: {row.fault}", soft_wrap=True, markup=False, highlight=False)
        settings = [(row.name, row.details.get("precision"), row.details.get("threads")) for row in result.rows if not row.fault]
        words = [
            f"{name} {precision}" + (f" x {threads}" if threads else "") for name, precision, threads in settings if precision
        ]
        if words:
            console.print(f"Precision x threads: {', '.join(words)}.", soft_wrap=True, markup=False, highlight=False)


def _table(result: SizeResult) -> Table:
    height, width = result.height, result.width
    runs = max(len(row.times) for row in result.rows)
    title = f"{width} x {height} to {2 * width} x {2 * height}, {runs} runs; ms, and of the first peer's"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    table.add_column("", no_wrap=True)
    kinds = ("wall\nmin", "\nmedian", "CPU\nmin", "\nmedian")
    for column in (*kinds, *kinds, "largest\nerror", "MiB\nat most"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in result.rows:
        if row.fault:
            table.add_row(row.name, *["-"] * 10)
            continue
        shares = result.shares(row)
        table.add_row(
            row.name,
            *(_number(row.summary.get(name), 1e3, 1) for name in SUMMARY),
            *(_number(shares.get(name), 1, 2) for name in SUMMARY),
            "-" if row.error is None else f"{row.error:.1e}",
            _number(row.peak_memory, 2**-20, 0),
        )
        for stage, seconds in row.stages.items():
            table.add_row(f"  {stage}", f"{seconds * 1e3:.1f}")
    return table


def _number(value: float | None, factor: float, digits: int) -> str:
    return "-" if value is None else f"{value * factor:.{digits}f}"


def to_json(results: Sequence[SizeResult], weights: str, threads: int, *, dark: bool = False) -> str:
    """All measurements, and the machine they were made on, as JSON; without names of hosts, users or folders.

    Args:
        results: of `bench`.
        weights: identity of the weights.
        threads: number of threads of each contender on the CPU.
        dark: see ``Setup``.
    """
    data = {
        "format": FORMAT,
        **conditions(PACKAGES),
        "threads": threads,
        "weights": weights,
        "dark": dark,
        "method": {
            "order": "in turns, one process each",
            "warm_up": WARM_UP,
            "pause_s": PAUSE,
            "cpu": "processor time of the contender's process, divided by the threads",
            "error": "largest difference from the float64 reference, same inputs",
        },
        "sizes": [
            {
                "input": [r.width, r.height],
                "output": [2 * r.width, 2 * r.height],
                "rows": [_row(r, row) for row in r.rows],
            }
            for r in results
        ],
    }
    return json.dumps(data, indent=1) + "\n"


def _row(result: SizeResult, row: Timing) -> dict[str, Any]:
    if row.fault:
        return {"name": row.name, "peer": row.name in PEERS, "details": row.details, "fault": row.fault}
    return {
        "name": row.name,
        "peer": row.name in PEERS,
        "minimum_ms": row.summary["wall_min"] * 1e3,
        "median_ms": row.summary["wall_median"] * 1e3,
        **{f"{name}_ms": row.summary[name] * 1e3 for name in ("cpu_min", "cpu_median") if name in row.summary},
        "of_first_peer": result.shares(row),
        "times_ms": [seconds * 1e3 for seconds in row.times],
        "cpu_times_ms": [seconds * 1e3 for seconds in row.cpu_times],
        "stages_ms": {stage: seconds * 1e3 for stage, seconds in row.stages.items()},
        "error": "inf" if row.error == float("inf") else row.error,
        "peak_memory_bytes": row.peak_memory,
        "details": row.details,
    }
