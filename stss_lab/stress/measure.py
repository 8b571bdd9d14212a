# SPDX-License-Identifier: MIT
"""`stss stress`: the digits that each stage loses, and how fast. It measures and does not judge.

The truth is the reference in float64 on the same float32 inputs, so the rounding of the inputs does not count unless a table says so.
An error is the largest difference over the largest number of the truth; a table's number is the worst of several seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from stss_ground.errors import InputError
from stss_lab.stress import sweeps
from stss_lab.stress.engines import Engine, OpenCLEngine, ReferenceEngine
from stss_lab.stress.positions import positions
from stss_lab.stress.subnormal import subnormal
from stss_lab.stress.table import StressPlan, StressTable
from stss_ref.weights import Weights

MEASUREMENTS: dict[str, Callable[[StressPlan], StressTable]] = {
    "bounds": sweeps.bounds,
    "magnitude": sweeps.magnitude,
    "weights": sweeps.weight_scale,
    "size": sweeps.size,
    "depth": sweeps.depth,
    "overflow": sweeps.overflow,
    "positions": positions,
    "subnormal": subnormal,
}
"""Name of a table -> function that measures it, in the order of the report."""


def check_names(only: Sequence[str]) -> None:
    """Raise InputError unless every name is one of ``MEASUREMENTS``."""
    for name in only:
        if name not in MEASUREMENTS:
            raise InputError(f"only: expected some of {', '.join(MEASUREMENTS)}, got {name!r}")


def make_plan(device: Any, weights: Weights | None) -> StressPlan:
    """Plan the measurements, of about half a minute on two cores.

    Args:
        device: an open ``stss_cl.device.discovery.Device``; None: the reference alone.
        weights: the 92 tensors; None: random ones, different for each seed.
    """
    engines: list[Engine] = [ReferenceEngine()]
    if device is not None:
        engines += [OpenCLEngine(device, precision) for precision in ("float32", "float32-direct", "half", "bfloat16")]
    return StressPlan(engines, weights=weights)


def stress(
    plan: StressPlan, only: Sequence[str] = (), on_step: Callable[[str], None] = lambda _: None
) -> tuple[StressTable, ...]:
    """Measure the tables.

    Args:
        plan: how much to measure.
        only: names of ``MEASUREMENTS``; empty: all.
        on_step: called with the name of each table when it is measured.

    Raises:
        InputError: a name is unknown.
    """
    check_names(only)
    tables: list[StressTable] = []
    for name, measure in MEASUREMENTS.items():
        if not only or name in only:
            tables.append(measure(plan))
            on_step(name)
    return tuple(tables)
