# SPDX-License-Identifier: MIT
"""Flicker of every method on canonical scenes whose cameras stand or turn slowly: only the method can cause it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from conformance.scenes import SCENES
from stss.frames.backends import Backend
from stss.frames.display_frame import DisplayFrame, window_at
from stss.frames.supersample import plan
from stss.quality.flicker import Change, change_between, display_motion
from stss.sequence.scenes import check_request, display_frames, truth
from stss_ref.arrays import Image

STILL = ("static", "slow-pan")
WARM = 7
"""Display frames before the first one measured, so that histories are full."""


@dataclass(frozen=True)
class Steadiness:
    """The flicker of a method on a scene.

    Attributes:
        change: mean over the frames.
        largest: largest ``|d - d*|`` of any pixel that can be followed, in 8-bit levels.
    """

    scene: str
    method: str
    change: Change
    largest: float


def measure(
    scenes: Sequence[str],
    methods: Sequence[str],
    make: Callable[[str], Backend],
    size: tuple[int, int],
    count: int,
    on_step: Callable[[str], None] = lambda _: None,
) -> list[Steadiness]:
    """Measure every method on every scene, compared with the scene's truth.

    Args:
        scenes: names in ``SCENES``.
        methods: names, for ``make``.
        make: opens a method's backend.
        size: (H, W) of the inputs.
        count: display frames, more than `WARM` + 1.
        on_step: called with the name of each step.

    Raises:
        InputError: there is no such scene, or there are too few frames.
    """
    check_request(scenes, count, WARM + 2)
    found: list[Steadiness] = []
    for name in scenes:
        on_step(f"{name}: rendering")
        frames = list(display_frames(SCENES[name], size, count))
        truths = [np.clip(truth(SCENES[name], size, number), 0, 1) for number in range(WARM, count)]
        motions = [display_motion(before, now) for before, now in zip(frames[WARM:], frames[WARM + 1 :], strict=False)]
        for method in methods:
            on_step(f"{name}: {method}")
            images = _images(frames, make(method))[WARM:]
            shown = list(zip(images, truths, strict=True))
            steps = [change_between(before, now, *motion) for before, now, motion in zip(shown, shown[1:], motions, strict=False)]
            found.append(Steadiness(name, method, _mean([step for step, _ in steps]), max(largest for _, largest in steps)))
    return found


def _images(frames: Sequence[DisplayFrame], backend: Backend) -> list[Image]:
    images: list[Image] = []
    for number in range(len(frames)):
        window = window_at(frames, number)
        planned = plan(window)
        assert planned is not None  # frame 0 is rendered
        images.append(np.clip(backend.compute(window, planned.steps)[0], 0, 1))
    return images


def _mean(changes: Sequence[Change]) -> Change:
    return Change(
        *(float(np.mean([getattr(change, name) or 0.0 for change in changes])) for name in ("output", "truth", "error"))
    )


def print_steadiness(found: Sequence[Steadiness], console: Console) -> None:
    """Print a table."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for heading in ("scene", "method", "output", "truth", "error", "largest"):
        table.add_column(heading, justify="left" if heading in ("scene", "method") else "right")
    for row in found:
        values = (row.change.output, row.change.truth, row.change.error, row.largest)
        table.add_row(row.scene, row.method, *(f"{value or 0.0:.2f}" for value in values))
    console.print(table)
