# SPDX-License-Identifier: MIT
"""Find the most accurate setting that computes frames within a given time, by trying settings on the first frames."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence

from stss.frames.backends import Backend
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import DisplayFrame, window_at
from stss.frames.supersample import plan
from stss_ground.errors import InputError

FRAMES = 16
"""Display frames that each setting is tried on."""
WARM = 8
"""Display frames before the first timed one."""


SETTINGS = (
    ComputeOptions(precision="float32", skip="exact"),
    ComputeOptions(precision="half", skip="exact"),
)
"""The settings to try, the most accurate first."""


def choose(
    frames: Sequence[DisplayFrame], budget: float, make: Callable[[ComputeOptions], Backend], tell: Callable[[str], None]
) -> tuple[ComputeOptions, Backend]:
    """Choose the first of `SETTINGS` whose frames take no longer than the budget, or else the fastest.

    Args:
        frames: consecutive display frames, the first of them rendered.
        budget: seconds a frame, the mean over the timed frames.
        make: opens the backend of a setting.
        tell: called with lines for the user.

    Returns:
        The setting and its backend.

    Raises:
        InputError: there are too few frames to try anything on.
    """
    if len(frames) <= WARM:
        raise InputError(f"--budget: expected more than {WARM} frames in a row to try settings on, got {len(frames)}")
    fastest: tuple[float, ComputeOptions] | None = None
    for setting in SETTINGS:
        backend = make(setting)
        seconds = measure(frames, backend)
        if seconds <= budget:
            tell(f"{setting.typed}: {seconds * 1e3:.1f} ms a frame, within {budget * 1e3:g} ms")
            return setting, backend
        tell(f"{setting.typed}: {seconds * 1e3:.1f} ms a frame")
        fastest = min(fastest or (seconds, setting), (seconds, setting), key=lambda pair: pair[0])
    assert fastest is not None
    tell(f"no setting keeps within {budget * 1e3:g} ms a frame: the fastest is taken, {fastest[1].typed}")
    return fastest[1], make(fastest[1])


def measure(frames: Sequence[DisplayFrame], backend: Backend) -> float:
    """Mean time of the frames after the first `WARM`; seconds."""
    times: list[float] = []
    for number in range(len(frames)):
        window = window_at(frames, number)
        planned = plan(window)
        if planned is None:
            continue
        start = time.perf_counter()
        backend.compute(window, planned.steps)
        times.append(time.perf_counter() - start)
    return statistics.mean(times[WARM:] or times[-1:])
