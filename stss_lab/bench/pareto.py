# SPDX-License-Identifier: MIT
"""``stss bench --pareto``: run time and error of every setting of the backend, on the canonical scenes."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from conformance.scenes import SCENES
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import DisplayFrame, frame_inputs, schedule_of, window_at
from stss.quality.metrics import psnr
from stss.sequence.scenes import check_request, display_frames, truth
from stss_cl.device.discovery import Device, open_device
from stss_cl.options import PRECISIONS, Precision
from stss_cl.skip.stream import Stream
from stss_ground.errors import InputError
from stss_ground.machine import conditions
from stss_ground.progress import show_steps
from stss_ground.terminal import Terminal
from stss_lab.bench.contender import Setup
from stss_lab.bench.report import FORMAT, PACKAGES
from stss_ref.arrays import Array, Image
from stss_ref.frame import FrameInputs, frame
from stss_ref.weights import Weights, astype

CANONICAL = ("static", "interface", "object", "sky", "cut", "pan", "flythrough")
"""Names of the scenes, those with the least change first."""
WARM = 8
"""Display frames before the first timed one; after them, histories are full and kernels built."""
JUDGED = 2
"""Number of last frames, an SF and an EF, that are compared with the float64 reference and with the truth."""

SETTINGS = tuple(ComputeOptions(precision=precision, skip=skip) for precision in PRECISIONS for skip in ("off", "exact"))
FULL: Precision = "float32"
"""The precision, without skipping, whose images all settings are compared with."""


def chosen_settings(words: Sequence[str] | None) -> tuple[ComputeOptions, ...]:
    """The settings of `SETTINGS` whose names contain one of ``words``; None: all but bfloat16, which is slow without matrix units.

    Raises:
        InputError: no name contains any of them.
    """
    settings = tuple(
        s for s in SETTINGS if (s.precision != "bfloat16" if words is None else any(word in s.name for word in words))
    )
    if not settings:
        raise InputError(f"--settings: expected parts of {', '.join(s.name for s in SETTINGS)}, got {', '.join(words or ())}")
    return settings


@dataclass(frozen=True)
class Point:
    """Times and errors of one setting on one scene.

    Attributes:
        setting: the setting.
        times: seconds of each timed frame.
        full: seconds of the same frames without skipping, in the same precision, timed in turns with ``times``.
        error: largest difference of the judged frames from the float64 reference, output units.
        departure: largest difference of all timed frames from those of `FULL` without skipping, output units.
        psnr: mean PSNR of the judged frames to the truth, dB.
        exact: whether every timed image has the same bits as these.
    """

    setting: ComputeOptions
    times: tuple[float, ...]
    full: tuple[float, ...]
    error: float
    departure: float
    psnr: float
    exact: bool

    @property
    def share(self) -> float:
        """The share of the time without skipping, by sums over the sequence, since its frames differ in cost."""
        return sum(self.times) / sum(self.full)


def bench_pareto(
    setups: Sequence[Setup], scenes: Sequence[str] | None, settings: Sequence[ComputeOptions], frames: int, console: Console
) -> dict[str, list[Point]]:
    """Measure each scene, and print its table.

    Args:
        setups: a single one, with weights, size and device.
        scenes: names in ``SCENES``; None: `CANONICAL`.
        settings: each is timed in turns with its precision without skipping: a frame of one, then the same frame of the other.
        frames: display frames of each scene, more than `WARM` + `JUDGED`.
        console: for progress.

    Returns:
        The points of each scene.

    Raises:
        InputError: there are several sizes, too few frames or no such scene, or a process that measured one died.
    """
    if len(setups) != 1:
        raise InputError(f"--pareto: expected one --size, got {len(setups)}")
    scenes = scenes or CANONICAL
    check_request(scenes, frames, WARM + JUDGED)
    points: dict[str, list[Point]] = {}
    with show_steps(console, len(scenes)) as begin:
        for scene in scenes:
            begin(f"{scene}: {len(settings)} settings")
            # A new process has none of the kernels and caches that another scene built.
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                try:
                    points[scene] = pool.submit(measure, setups[0], scene, settings, frames).result()
                except BrokenProcessPool:
                    raise InputError(f"{scene}: the process that measured it died") from None
            print_points(scene, points[scene], Terminal())
    return points


def to_json(results: Mapping[str, Sequence[Point]], setup: Setup, weights: str) -> str:
    """The points of each scene, and the machine they were measured on, as JSON; without names of hosts, users or folders.

    Args:
        results: of `bench_pareto`.
        setup: its setup.
        weights: identity of its weights.
    """
    data = {
        "format": FORMAT,
        **conditions(PACKAGES),
        "threads": setup.threads,
        "weights": weights,
        "input": [setup.width, setup.height],
        "share": f"of the same precision's time without skipping; departure from {FULL} without skipping",
        "scenes": {scene: [_row(point) for point in points] for scene, points in results.items()},
    }
    return json.dumps(data, indent=1) + "\n"


def _row(point: Point) -> dict[str, Any]:
    return {
        "setting": point.setting.name,
        "median_ms": statistics.median(point.times) * 1e3,
        "worst_ms": max(point.times) * 1e3,
        "share": point.share,
        "times_ms": [seconds * 1e3 for seconds in point.times],
        "full_times_ms": [seconds * 1e3 for seconds in point.full],
        "error": point.error,
        "departure": point.departure,
        "psnr": point.psnr,
        "exact": point.exact,
    }


def print_points(scene: str, points: Sequence[Point], console: Console) -> None:
    """Print the table of a scene."""
    table = Table(title=scene, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    table.add_column("", no_wrap=True)
    for column in ("ms\nmedian", "ms\nworst", "share of\noff's time", "error to\nfloat64", f"departure\nfrom {FULL}", "PSNR\ndB"):
        table.add_column(column, justify="right", no_wrap=True)
    for point in points:
        table.add_row(
            point.setting.name,
            f"{statistics.median(point.times) * 1e3:.1f}",
            f"{max(point.times) * 1e3:.1f}",
            f"{point.share:.3f}",
            f"{point.error:.1e}",
            "same bits" if point.exact else f"{point.departure * 255:.2f}/255",
            f"{point.psnr:.2f}",
        )
    console.print(table)


def measure(setup: Setup, scene: str, settings: Sequence[ComputeOptions], count: int) -> list[Point]:
    """A point for every setting on a scene of ``count`` display frames."""
    size, device = (setup.height, setup.width), open_device(setup.device)
    frames = list(display_frames(SCENES[scene], size, count))
    truths = {n: (_reference(frames, n, setup.weights), truth(SCENES[scene], size, n)) for n in range(count - JUDGED, count)}
    return [compare_setting(setting, setup.weights, device, frames, truths) for setting in settings]


def window_and_steps(frames: Sequence[DisplayFrame], number: int) -> tuple[Sequence[DisplayFrame], tuple[int, int, int]]:
    """The window of a display frame, and the steps of its schedule."""
    window = window_at(frames, number)
    schedule = schedule_of(window)
    assert schedule is not None  # frame 0 is rendered
    return window, schedule.steps


def _reference(frames: Sequence[DisplayFrame], number: int, weights: Weights) -> Image:
    inputs = frame_inputs(*window_and_steps(frames, number))
    arrays: dict[str, Array] = {name: value for name, value in vars(inputs).items() if name != "steps"}
    exact = {name: value.astype(np.float64) for name, value in arrays.items()}
    return frame(FrameInputs(**exact, steps=inputs.steps), astype(weights, np.float64))[0]


def compare_setting(
    setting: ComputeOptions,
    weights: Weights,
    device: Device,
    frames: Sequence[DisplayFrame],
    truths: dict[int, tuple[Image, Image]],
) -> Point:
    """Run a setting in turns with the streams for comparison; ``truths``: number -> the reference's image, and the scene's."""
    candidate = Stream(weights, device, setting.precision, skip=setting.skip)
    off = Stream(weights, device, setting.precision, skip="off")
    streams = [candidate, off] if setting.precision == FULL else [candidate, off, Stream(weights, device, FULL, skip="off")]
    times = [list[float]() for _ in streams]
    errors, scores, departures, same = [0.0], list[float](), [0.0], True
    for number in range(len(frames)):
        window, steps = window_and_steps(frames, number)
        images: list[Image] = []
        for stream, seconds in zip(streams, times, strict=True):
            start = time.perf_counter()
            images.append(stream(window, steps)[0])
            seconds.append(time.perf_counter() - start)
        if number >= WARM:
            same = same and np.array_equal(images[0].view(np.uint32), images[-1].view(np.uint32))
            departures.append(0.0 if same else float(np.abs(images[0] - images[-1]).max()))
        if number in truths:
            exact, scene = truths[number]
            errors.append(float(np.abs(images[0] - exact).max()))
            scores.append(psnr(255 * np.clip(images[0], 0, 1), 255 * np.clip(scene, 0, 1)) or 0.0)
        images.clear()  # the backend copies an image that the caller holds, and overwrites any other
    return Point(
        setting,
        tuple(times[0][WARM:]),
        tuple(times[1][WARM:]),
        max(errors),
        max(departures),
        statistics.mean(scores),
        same,
    )
