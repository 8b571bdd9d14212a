# SPDX-License-Identifier: MIT
"""The work of a worker: some frames of a run, as bytes for the process that writes them."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock

from stss.frames.accumulation import Accumulation, accumulates
from stss.frames.backends import Backend, open_backend
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import WINDOW
from stss.run.frame_job import FrameJob, FrameReport, frame_name
from stss.run.options import RunOptions
from stss.sequence.sequence import Sequence
from stss.weights.file import LoadedWeights
from stss_ground.errors import DeviceError, InputError
from stss_ground.version import VERSION
from stss_ref.arrays import ArrayError


@dataclass(frozen=True)
class Engine:
    """The arguments of `stss.frames.backends.open_backend`: a worker opens its own backend."""

    loaded: LoadedWeights
    backend: str
    compute: ComputeOptions

    @property
    def window(self) -> int:
        """The number of display frames that an output depends on."""
        return Accumulation.window if accumulates(self.loaded, self.compute) else WINDOW


@dataclass(frozen=True)
class Work:
    """A run, or the part of it that a chunk needs.

    Attributes:
        version: of the writing process; a worker of another version would make other files.
        sequence: the sequence; the worker reads the same paths.
        rendered: the display frames that count as rendered.
        out: the run's folder, for messages and suffixes; the worker writes nothing.
        options: as for a run in one process.
        engine: computes the frames.
    """

    version: str
    sequence: Sequence
    rendered: frozenset[int]
    out: Path
    options: RunOptions
    engine: Engine

    def part(self, numbers: Iterable[int]) -> Work:
        """The work with only the frames on which those of ``numbers`` depend."""
        ordered = sorted(numbers)
        needs = {self.sequence.numbers[0], *range(ordered[0] - self.engine.window + 1, ordered[-1] + 1)}
        return replace(self, sequence=self.sequence.part(needs))


@dataclass(frozen=True)
class Introduction:
    """A worker's backend, its method and the label of its weights, or the reason why it cannot work."""

    backend: str
    method: str
    weights: str
    error: str = ""


@dataclass(frozen=True)
class Chunk:
    """The result of a worker.

    Attributes:
        frames: the reports of its frames, each with its files in the order to write them.
        backend: the worker's; "": it could not be opened.
        seconds: the time it took.
        error: why it ended early, or "".
    """

    frames: list[tuple[FrameReport, dict[str, bytes]]]
    backend: str
    seconds: float
    error: str = ""


class _Files:
    """Takes the files of frames; see ``stss.run.frame_job.Sink``."""

    def __init__(self, path: Path):
        self.path, self._files = path, dict[str, dict[str, bytes]]()

    def write(self, name: str, data: bytes) -> None:
        self._files.setdefault(Path(name).stem, {})[name] = data

    def take(self, number: int) -> dict[str, bytes]:
        return self._files.pop(Path(frame_name(number, "exr")).stem, {})


_lock = Lock()
"""A worker computes one chunk at a time, for any number of its threads."""
_opened: dict[str, tuple[Backend, str]] = {}
"""The last run's options for its backend -> the backend, and the label of its weights."""


def introduce(work: Work) -> Introduction:
    """Open the backend; returns its name, or why it cannot be opened."""
    try:
        for path in work.sequence.files(work.sequence.numbers[0]):
            if not path.is_file():
                raise InputError(f"{path}: not there; workers read the same paths, from shared storage")
        with _lock:
            backend, label = _open(work)
            return Introduction(backend.name, backend.method, label)
    except (InputError, DeviceError, OSError) as error:
        return Introduction("", "", "", str(error))


def compute_chunk(work: Work, numbers: list[int]) -> Chunk:
    """Compute display frames, given in order."""
    frames: list[tuple[FrameReport, dict[str, bytes]]] = []
    name, error, start = "", "", time.monotonic()
    with _lock:
        try:
            backend, label = _open(work)
            name, files = backend.name, _Files(work.out)
            job = FrameJob.of(work.sequence, work.rendered, work.options, backend, label, files, _nothing_written)
            with closing(job.run(deque(numbers), work.sequence.size)) as reports:
                for report in reports:
                    frames.append((report, files.take(report.number)))
        except (InputError, ArrayError, DeviceError) as caught:
            error = str(caught)
    return Chunk(frames, name, time.monotonic() - start, error)


def _open(work: Work) -> tuple[Backend, str]:
    if work.version != VERSION:
        raise InputError(f"a worker has stss {VERSION}; expected {work.version}, as on the machine that started the run")
    engine = work.engine
    key = f"{engine.loaded.label} {engine.backend} {engine.compute}"
    if key not in _opened:
        _opened.clear()
        _opened[key] = (open_backend(engine.backend, engine.loaded, engine.compute), engine.loaded.label)
    return _opened[key]


def _nothing_written(number: int, key: str) -> None:
    """The writing process knows the frames that are kept, and asks only for the rest."""
    del number, key
