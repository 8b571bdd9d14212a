# SPDX-License-Identifier: MIT
"""A picture of the newest frame, written again and again during a long run."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path

from stss.images.color import transfer
from stss.images.read_write import encode_rgb, read_rgb
from stss.run.frame_job import FrameReport, frame_name
from stss.run.job import folder_of
from stss.run.options import RunOptions
from stss_ground.errors import InputError
from stss_ground.output.apart import require_places
from stss_ground.output.write_whole import write_named

EVERY = 10.0
"""Seconds between pictures: often enough for a viewer that reloads, seldom enough not to slow the run down."""


def require_preview(path: Path, out: Path, reads: Iterable[Path]) -> None:
    """Raise InputError if a preview cannot be written there: before the run, not during it."""
    if path.suffix.lower() != ".png":
        raise InputError(f"--preview {path}: expected a name ending in .png")
    require_places({"--preview": path}, reads, folders=[folder_of(out)])


class Preview:
    """Writes the newest frame, as a screen shows it, over and over into one file.

    Args:
        path: the file, a ``.png``.
        out: the run's folder.
        options: of the run.
        clock: the time in seconds, from any origin.
    """

    def __init__(self, path: Path, out: Path, options: RunOptions, clock: Callable[[], float] = time.monotonic):
        self._path, self._out, self._options, self._clock = path, out, options, clock
        self._next = clock()

    def show(self, report: FrameReport) -> None:
        """Write the frame if it was made and `EVERY` seconds have passed since the last one."""
        if report.outcome == "left out" or self._clock() < self._next:
            return
        image = read_rgb(self._out / frame_name(report.number, self._options.format))
        shown = image if self._options.format == "png" else transfer(self._options.transfer).display(image)
        write_named(self._path, encode_rgb(self._path, shown, metadata={"stss:frame": str(report.number)}))
        self._next = self._clock() + EVERY
