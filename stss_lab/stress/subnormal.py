# SPDX-License-Identifier: MIT
"""Whether time depends on the data: the processor's time for inputs so small that they, or products of them, are subnormal numbers.

Processors of Intel take a hundred cycles for each operation that has a subnormal number, unless it is flushed to 0.
"""

from __future__ import annotations

import time

from conformance.protocol.port import Arrays
from stss_lab.stress.engines import IMAGE, Engine
from stss_lab.stress.inputs import frame_noise, image_noise, scale
from stss_lab.stress.table import StressPlan, StressTable
from stss_ref.weights import Weights

LIGHT = (1.0, 1e-10, 1e-20, 1e-38, 1e-42, 0.0)
"""Factors of the inputs: products with small weights become subnormal, then the inputs themselves."""
RUNS = 5
"""Runs of each, of which the fastest counts."""
GROWTH = 2
"""The frames' sides over those of the plan: then the time before a launch is negligible."""


def subnormal(plan: StressPlan) -> StressTable:
    """Processor time for dark inputs, over that for light ones; of the backend, which flushes everywhere.

    bfloat16 is left out: it has no subnormal numbers, and is slow where it is emulated.
    """
    size = tuple(GROWTH * side for side in plan.size)
    weights, stages = plan.weights_of(0), {"network": frame_noise(0, *size), **image_noise(0, *size)}
    rows = [
        (stage, engine.name, *_times(engine, stage, inputs, weights))
        for stage, inputs in stages.items()
        for engine in plan.engines[1:]
        if engine.dtype != "bfloat16" and (stage not in IMAGE or stage in engine.stages())
    ]
    headings = tuple(f"{light:g}" for light in LIGHT)
    return StressTable(
        "subnormal",
        "Inputs times a factor: processor time, as a share of the first column's",
        ("stage", "", *headings),
        tuple(rows),
    )


def _times(engine: Engine, stage: str, inputs: Arrays, weights: Weights) -> list[float]:
    seconds = [_seconds(engine, stage, scale(stage, inputs, light), weights) for light in LIGHT]
    return [each / seconds[0] for each in seconds]


def _seconds(engine: Engine, stage: str, inputs: Arrays, weights: Weights) -> float:
    engine.run(stage, inputs, weights)
    times: list[float] = []
    for _ in range(RUNS):
        start = time.process_time()
        engine.run(stage, inputs, weights)
        times.append(time.process_time() - start)
    return min(times)
