# SPDX-License-Identifier: MIT
"""Subcommand `stss stress`; it imports its modules when it runs."""

from __future__ import annotations

from functools import partial
from typing import Any

import click

from stss.frames.backends import BACKENDS
from stss.weights.file import load
from stss_ground.commands import Subcommand
from stss_ground.errors import InputError
from stss_ground.option_kinds import Names, ReadName
from stss_ground.progress import show_progress
from stss_ground.terminal import Terminal, echo


@click.command("stress", cls=Subcommand)
@click.option("--backend", type=click.Choice(BACKENDS), default="cl", show_default=True, help="ref: only the reference.")
@click.option("--device", help="Part of an OpenCL device's name (stss devices)  [default: $STSS_DEVICE, or the fastest]")
@click.option("--weights", type=ReadName(), help="A .safetensors file  [default: random weights, different for each seed]")
@click.option("--only", type=Names(), default="", help="Names of tables: magnitude,positions,...  [default: all]")
def stress_command(backend: str, device: str | None, weights: str | None, only: tuple[str, ...]) -> None:
    """Measure where digits are lost: with magnitude, depth, size, and in the worst places."""
    from stss_lab.stress.measure import MEASUREMENTS, check_names, make_plan, stress
    from stss_lab.stress.report import print_tables

    check_names(only)
    tensors = None if weights is None else load(weights).weights
    chosen_device = _open(backend, device)
    plan = make_plan(chosen_device, tensors)
    console = Terminal(stderr=True)
    with show_progress(console, len(only or MEASUREMENTS), "measurements") as advance:
        tables = stress(plan, only, on_step=advance)
    print_tables(tables, plan, None if chosen_device is None else f"{chosen_device.name}, {chosen_device.driver}", Terminal())


def _open(backend: str, device: str | None) -> Any:
    """The OpenCL device; None for the reference alone."""
    if backend == "cl":
        from stss.devices.selection import choose

        return choose(device, partial(echo, err=True))
    if device is not None:
        raise InputError("backend ref: expected no device")
    return None
