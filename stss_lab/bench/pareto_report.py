# SPDX-License-Identifier: MIT
"""Report run time against error as a table and as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from stss.frames.compute_options import ComputeOptions
from stss.sequence.scenes import check_request
from stss.weights.file import identity
from stss_cl.device.discovery import open_device
from stss_ground.errors import InputError
from stss_ground.machine import conditions
from stss_ground.output.write_whole import write_named
from stss_ground.progress import show_steps
from stss_ground.terminal import Terminal
from stss_lab.bench.contender import Setup
from stss_lab.bench.pareto import CANONICAL, JUDGED, WARM, Point, frontier, measure
from stss_lab.bench.report import PACKAGES

FORMAT = 2
"""Version of the JSON; raised when a field changes its meaning."""


def bench_pareto(
    setups: Sequence[Setup],
    scenes: Sequence[str] | None,
    settings: Sequence[ComputeOptions],
    frames: int,
    console: Console,
    json_file: Path | None,
) -> None:
    """Run ``stss bench --pareto``: measure, print and write the points.

    Args:
        setups: a single one, with weights, size and device.
        scenes: names of canonical scenes; None: all.
        settings: to measure.
        frames: display frames of each scene.
        console: for progress and tables.
        json_file: to write; None: none.

    Raises:
        InputError: there are several sizes, or a name is unknown.
    """
    if len(setups) != 1:
        raise InputError(f"--pareto: expected one --size, got {len(setups)}")
    setup, size = setups[0], (setups[0].height, setups[0].width)
    points: list[Point] = []
    scenes = scenes or CANONICAL
    check_request(scenes, frames, WARM + JUDGED)
    with show_steps(console, len(scenes)) as begin:
        for scene in scenes:
            begin(f"{scene}: {len(settings)} settings")
            points += (found := in_its_own_process(setup, scene, settings, frames))
            print_points(found, Terminal())
    if json_file is not None:
        write_json(json_file, points, identity(setup.weights), size)


def in_its_own_process(setup: Setup, scene: str, settings: Sequence[ComputeOptions], frames: int) -> list[Point]:
    """Measure the points of a scene in a new process, which has none of the kernels and caches that another scene built.

    Raises:
        InputError: the process died.
    """
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        try:
            return pool.submit(_points, setup, scene, settings, frames).result()
        except BrokenProcessPool:
            raise InputError(f"{scene}: the process that measured it died") from None


def _points(setup: Setup, scene: str, settings: Sequence[ComputeOptions], frames: int) -> list[Point]:
    size = setup.height, setup.width
    return list(measure(setup.weights, open_device(setup.device), [scene], settings, size, frames))


def print_points(points: Sequence[Point], console: Console) -> None:
    """Print a table for each scene; a star marks the settings that no other setting beats in both time and error."""
    for scene in dict.fromkeys(point.scene for point in points):
        rows = [point for point in points if point.scene == scene]
        best = frontier([(point.ratio, point.error) for point in rows])
        table = Table(title=scene, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
        table.add_column("", no_wrap=True)
        columns = ("", "ms\nmedian", "ms\nworst", "share of\noff's time", "error to\nfloat64", "departure\nfrom off", "PSNR\ndB")
        for column in columns:
            table.add_column(column, justify="right", no_wrap=True)
        for i, point in enumerate(rows):
            table.add_row(
                point.setting.name,
                "*" if i in best else "",
                f"{point.median * 1e3:.1f}",
                f"{max(point.times) * 1e3:.1f}",
                f"{point.ratio:.3f}",
                f"{point.error:.1e}",
                "same bits" if point.exact else f"{point.departure * 255:.2f}/255",
                f"{point.psnr:.2f}",
            )
        console.print(table)


def write_json(path: Path, points: Sequence[Point], weights: str, size: tuple[int, int]) -> None:
    """Write the time of every frame as JSON, and the machine it was measured on.

    Raises:
        InputError: it can't be written.
    """
    data: dict[str, Any] = {
        "format": FORMAT,
        **conditions(PACKAGES),
        "weights": weights,
        "input": [size[1], size[0]],
        "points": [
            {
                "scene": point.scene,
                "setting": point.setting.name,
                "times_ms": [seconds * 1e3 for seconds in point.times],
                "times_of_off_ms": [seconds * 1e3 for seconds in point.full],
                "share": point.ratio,
                "error": point.error,
                "departure": point.departure,
                "same_bits": point.exact,
                "psnr": point.psnr,
            }
            for point in points
        ],
    }
    write_named(path, json.dumps(data, indent=1) + "\n")
