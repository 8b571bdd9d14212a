# SPDX-License-Identifier: MIT
"""The progress of a run."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager

from rich.console import Console

from stss.run.frame_job import FrameReport
from stss.run.preview import Preview
from stss_ground.progress import show_progress


@contextmanager
def show_frames(
    console: Console, total: int, preview: Preview | None = None
) -> Generator[Callable[[FrameReport], None], None, None]:
    """Show the progress of ``total`` frames with the share that was skipped; see `show_progress`.

    Args:
        console: where to show it.
        total: number of frames.
        preview: gets every frame as well; None: no preview.

    Yields:
        The function to call with the report of every frame.
    """
    tally = Tally()
    with show_progress(console, total, text="building kernels") as advance:

        def on_frame(report: FrameReport) -> None:
            advance(tally.add(report))
            if preview is not None:
                preview.show(report)

        yield on_frame


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
