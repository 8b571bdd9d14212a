# SPDX-License-Identifier: MIT
"""The progress bar of a run."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from stss.run.frame_job import FrameReport
from stss.run.preview import Preview

A_MINUTE = 60
"""Seconds between the lines in a log file."""


@contextmanager
def shown_progress(
    console: Console, total: int, preview: Preview | None = None
) -> Generator[Callable[[FrameReport], None], None, None]:
    """Show a bar with frames a second, time left and the share that was skipped; in a log file, a line a minute.

    Args:
        console: where to show it.
        total: number of frames.
        preview: gets every frame as well; None: no preview.

    Yields:
        The function to call with the report of every frame.
    """
    tally, log = Tally(), None if console.is_terminal else LogLines(console, total)
    with _bar(console) as progress:
        task = progress.add_task("building kernels", total=total)

        def on_frame(report: FrameReport) -> None:
            progress.update(task, advance=1, description=tally.add(report))
            if log is not None:
                log.add()
            if preview is not None:
                preview.show(report)

        yield on_frame


class LogLines:
    """A line a minute, for output that goes to a file."""

    def __init__(self, console: Console, total: int, clock: Callable[[], float] = time.monotonic):
        self._console, self._total, self._clock = console, total, clock
        self._done, self._start = 0, clock()
        self._last = self._start

    def add(self) -> None:
        """Count a frame, and say how far the run is where a minute has passed since the last line."""
        self._done += 1
        now = self._clock()
        if now - self._last >= A_MINUTE:
            self._last = now
            rate = self._done / (now - self._start)
            left = timedelta(seconds=round((self._total - self._done) / rate))
            self._console.print(f"{self._done} of {self._total} frames, {rate:.2f} frames/s, {left} left", highlight=False)


class Tally:
    """Counts how much of the network was left out so far."""

    def __init__(self) -> None:
        self._seen = 0
        self._computed = 0.0

    def add(self, report: FrameReport) -> str:
        """Count a frame; returns the share of all frames' network inputs that had not changed, as text; "" if none was looked at."""
        if report.cost is not None:
            self._seen += 1
            self._computed += 0.0 if report.cost.network == "none" else report.cost.changed
        return "" if not self._seen else f"skipped {1 - self._computed / self._seen:.0%}"


def _bar(console: Console) -> Progress:
    class Rate(TextColumn):
        def __init__(self) -> None:
            super().__init__("{task.speed}")

        def render(self, task: Any) -> Any:
            self.text_format = "" if not task.speed else f"{task.speed:.2f} frames/s"
            return super().render(task)

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(), MofNCompleteColumn(), Rate(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )  # fmt: skip
