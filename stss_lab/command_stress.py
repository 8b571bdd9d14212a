# SPDX-License-Identifier: MIT
"""Subcommand `stss stress`; what it needs is imported only when it runs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from stss.frames.backends import BACKENDS
from stss.weights.file import load
from stss_ground.errors import InputError
from stss_ground.option_kinds import PATH, Names
from stss_ground.output.apart import require_places
from stss_ground.progress import show_progress
from stss_ground.terminal import Terminal, echo


@click.command("stress")
@click.option("--backend", type=click.Choice(BACKENDS), default="cl", show_default=True, help="ref: the reference alone.")
@click.option("--device", help="Part of an OpenCL device's name (stss devices)  [default: $STSS_DEVICE, or the fastest]")
@click.option("--weights", help="A .safetensors file  [default: random weights, different for each seed]")
@click.option("--only", type=Names(), default="", help="Names of tables: magnitude,positions,...  [default: all]")
@click.option("--full", is_flag=True, help="More seeds and larger frames: some ten minutes.")
@click.option("--json", "json_file", type=PATH, help="File for every number, the versions and the machine.")
def stress_command(
    backend: str,
    device: str | None,
    weights: str | None,
    only: tuple[str, ...],
    full: bool,
    json_file: Path | None,
) -> None:
    """Measure where digits are lost: with magnitude, depth, size, and in the worst places."""
    from stss_lab.stress import report as stress_report
    from stss_lab.stress.measure import MEASUREMENTS, Results, check_names, make_plan, stress

    check_names(only)
    require_places({"--json": json_file}, [None if weights is None else Path(weights)])
    tensors = None if weights is None else load(weights).weights
    opened = _open(backend, device)
    plan = make_plan(opened, tensors, full=full)
    console = Terminal(stderr=True)
    with show_progress(console, len(only or MEASUREMENTS), "measurements") as advance:
        tables = stress(plan, only, on_step=advance)
    results = Results(plan, None if opened is None else f"{opened.name}, {opened.driver}", tables)
    stress_report.print_results(results, Terminal())
    if json_file is not None:
        stress_report.write_json(json_file, results)


def _open(backend: str, device: str | None) -> Any:
    """The OpenCL device; None for the reference alone."""
    if backend == "cl":
        from stss.devices.selection import choose

        return choose(device, partial(echo, err=True))
    if device is not None:
        raise InputError("backend ref: expected no device")
    return None
