# SPDX-License-Identifier: MIT
"""``stss bench --model``: the model's launches as a table and as JSON, beside measured times if there is a device."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from stss.bench.gpu_model import GPUS, Estimate, Gpu, measure, predict, predict_frame
from stss.errors import InputError
from stss.output.write_whole import write_named
from stss_cl.network.network import Precision
from stss_ref.weights import Weights


def gpu_named(name: str) -> Gpu:
    """The GPU of this name in ``GPUS``.

    Raises:
        InputError: there is no GPU of this name.
    """
    if name not in GPUS:
        raise InputError(f"--model: expected one of {', '.join(GPUS)}, got {name!r}")
    return GPUS[name]


def bench_model(
    weights: Weights,
    size: tuple[int, int],
    gpu: Gpu,
    precision: Precision,
    console: Console,
    json_file: Path | None,
    *,
    measured: bool,
    device: str | None,
) -> None:
    """Print the model's table for one size, and write it as JSON.

    Args:
        weights: the 92 tensors.
        size: (height, width) of the inputs; pixels.
        gpu: the GPU.
        precision: of the network.
        console: for the table.
        json_file: for every number; None: write none.
        measured: also time the launches on a device that is here.
        device: part of the name of that device; None: the default.
    """  # fmt: skip
    if measured:
        (rows, times, total), around = measure(weights, *size, gpu, precision, device), []
    else:
        rows, times, total = predict(weights, *size, gpu, precision), None, None
        around = predict_frame(weights, *size, gpu, precision)
    console.print(_table(rows, around, times, total, f"{gpu.name}, {precision}, {size[1]} x {size[0]}: a model, not measured"))
    if json_file is not None:
        write_named(json_file, json.dumps(_json(rows, around, times, total, gpu, precision, size), indent=1) + "\n")


def _table(
    rows: Sequence[Estimate], around: Sequence[Estimate], times: Sequence[float] | None, total: float | None, title: str
) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    for name in ("launch", "kernel", "limit"):
        table.add_column(name, no_wrap=True)
    for name in ("roof us", "model us", *(("measured us",) if times else ())):
        table.add_column(name, justify="right", no_wrap=True)
    for i, row in enumerate(rows):
        shown = [f"{row.roof * 1e6:.1f}", f"{row.total * 1e6:.1f}", *([f"{times[i] * 1e6:.1f}"] if times else [])]
        table.add_row(f"{row.stage} {row.name}", row.kernel, row.limit, *shown)
    shown = [f"{sum(row.roof for row in rows) * 1e6:.0f}", f"{_total(rows) * 1e6:.0f}"]
    table.add_row(f"all {len(rows)}", "", "", *shown, *([f"{total * 1e6:.0f}"] if total is not None else []))
    for row in around:
        table.add_row(f"{row.stage} {row.name}", row.kernel, row.limit, "", f"{row.total * 1e6:.1f}")
    if around:
        table.add_row(f"whole frame {len(rows) + len(around)}", "", "", "", f"{_total([*rows, *around]) * 1e6:.0f}")
    return table


def _total(rows: Sequence[Estimate]) -> float:
    return sum(row.total for row in rows)


def _json(
    rows: Sequence[Estimate],
    around: Sequence[Estimate],
    times: Sequence[float] | None,
    total: float | None,
    gpu: Gpu,
    precision: str,
    size: tuple[int, int],
) -> dict[str, object]:
    return {
        "format": 1,
        "gpu": gpu.name,
        "precision": precision,
        "input": [size[1], size[0]],
        "roof_ms": sum(row.roof for row in rows) * 1e3,
        "model_ms": _total(rows) * 1e3,
        "frame_model_ms": _total([*rows, *around]) * 1e3 if around else None,
        "measured_ms": None if total is None else total * 1e3,
        "launches": [
            {
                "stage": row.stage,
                "name": row.name,
                "kernel": row.kernel,
                "limit": row.limit,
                "roof_us": row.roof * 1e6,
                "model_us": row.total * 1e6,
                "limits_us": {key: seconds * 1e6 for key, seconds in row.seconds.items()},
                "measured_us": None if times is None else times[i] * 1e6,
            }
            for i, row in enumerate(rows)
        ],
    }
