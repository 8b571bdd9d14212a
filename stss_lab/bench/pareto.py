# SPDX-License-Identifier: MIT
"""Measure run time and error of every setting of the backend, on the canonical scenes."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from conformance.scenes import SCENES
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import DisplayFrame, frame_inputs, window_at
from stss.frames.supersample import plan
from stss.quality.metrics import psnr
from stss.sequence.scenes import check_request, display_frames, truth
from stss_cl.device.discovery import Device
from stss_cl.network.network import PRECISIONS
from stss_cl.skip.stream import Stream
from stss_ground.errors import InputError
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
FULL = SETTINGS[0]


def chosen_settings(words: Sequence[str] | None) -> tuple[ComputeOptions, ...]:
    """The settings of `SETTINGS` whose names contain one of ``words``; None: all but bfloat16, which is slow without matrix units.

    Raises:
        InputError: no name contains any of them.
    """
    chosen = tuple(s for s in SETTINGS if (s.precision != "bfloat16" if words is None else any(word in s.name for word in words)))
    if not chosen:
        raise InputError(f"--settings: expected parts of {', '.join(s.name for s in SETTINGS)}, got {', '.join(words or ())}")
    return chosen


@dataclass(frozen=True)
class Point:
    """Times and errors of one setting on one scene.

    Attributes:
        scene: its name.
        setting: the setting.
        times: seconds of each timed frame.
        full: seconds of the same frames with the setting `FULL`, timed in turns with ``times``.
        error: largest difference of the judged frames from the float64 reference, output units.
        departure: largest difference of all timed frames from those of `FULL`, output units.
        psnr: mean PSNR of the judged frames to the truth, dB.
        exact: whether every timed image has the same bits as with `FULL`.
    """

    scene: str
    setting: ComputeOptions
    times: tuple[float, ...]
    full: tuple[float, ...]
    error: float
    departure: float
    psnr: float
    exact: bool

    @property
    def ratio(self) -> float:
        """Time / time of `FULL`. Both are sums over the sequence, since its frames differ in cost."""
        return sum(self.times) / sum(self.full)

    @property
    def median(self) -> float:
        """Median time of a frame; seconds."""
        return statistics.median(self.times)


def measure(
    weights: Weights,
    device: Device,
    scenes: Sequence[str],
    settings: Sequence[ComputeOptions],
    size: tuple[int, int],
    count: int,
    on_step: Callable[[str], None] = lambda _: None,
) -> Iterator[Point]:
    """Yield a point for every scene and setting.

    Args:
        weights: the 92 tensors.
        device: to run on.
        scenes: names in ``SCENES``.
        settings: each is timed in turns with `FULL`: a frame of one, then the same frame of the other.
        size: (H, W) of the inputs.
        count: display frames of a sequence, more than `WARM` + `JUDGED`.
        on_step: called with a line before each step.

    Raises:
        InputError: there is no such scene, or there are too few frames.
    """
    check_request(scenes, count, WARM + JUDGED)
    for name in scenes:
        on_step(f"{name}: rendering")
        frames = list(display_frames(SCENES[name], size, count))
        on_step(f"{name}: float64 reference and truth")
        judged = {n: (_reference(frames, n, weights), truth(SCENES[name], size, n)) for n in range(count - JUDGED, count)}
        for setting in settings:
            on_step(f"{name}: {setting.name}")
            yield _point(name, setting, weights, device, frames, judged)


def _window(frames: Sequence[DisplayFrame], number: int) -> tuple[Sequence[DisplayFrame], tuple[int, int, int]]:
    window = window_at(frames, number)
    planned = plan(window)
    assert planned is not None  # frame 0 is rendered
    return window, planned.steps


def _reference(frames: Sequence[DisplayFrame], number: int, weights: Weights) -> Image:
    inputs = frame_inputs(*_window(frames, number))
    arrays: dict[str, Array] = {name: value for name, value in vars(inputs).items() if name != "steps"}
    exact = {name: value.astype(np.float64) for name, value in arrays.items()}
    return frame(FrameInputs(**exact, steps=inputs.steps), astype(weights, np.float64))[0]


def _point(
    scene: str,
    setting: ComputeOptions,
    weights: Weights,
    device: Device,
    frames: Sequence[DisplayFrame],
    judged: dict[int, tuple[Image, Image]],
) -> Point:
    full = Stream(weights, device, FULL.precision, skip="off")
    tried = Stream(weights, device, setting.precision, skip=setting.skip)
    times: tuple[list[float], list[float]] = [], []
    errors, scores, departures, same = [0.0], list[float](), [0.0], True
    for number in range(len(frames)):
        window, steps = _window(frames, number)
        images: list[Image] = []
        for stream, kept in zip((full, tried), times, strict=True):
            start = time.perf_counter()
            images.append(stream(window, steps)[0])
            kept.append(time.perf_counter() - start)
        if number >= WARM:
            same = same and np.array_equal(images[0].view(np.uint32), images[1].view(np.uint32))
            departures.append(0.0 if same else float(np.abs(images[1] - images[0]).max()))
        if number in judged:
            exact, seen = judged[number]
            errors.append(float(np.abs(images[1] - exact).max()))
            scores.append(psnr(255 * np.clip(images[1], 0, 1), 255 * np.clip(seen, 0, 1)) or 0.0)
        images.clear()  # the backend copies an image that someone holds, and overwrites one that nobody does
    return Point(
        scene,
        setting,
        tuple(times[1][WARM:]),
        tuple(times[0][WARM:]),
        max(errors),
        max(departures),
        statistics.mean(scores),
        same,
    )


def frontier(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points (time, error) that no other point beats in both, by rising time."""
    found: list[int] = []
    for i in sorted(range(len(points)), key=lambda i: points[i]):
        if not found or points[i][1] < points[found[-1]][1]:
            found.append(i)
    return found
