# SPDX-License-Identifier: MIT
"""The code that runs on a worker: it opens its backend once for a run, and computes one chunk after the other."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

from stss.frames.backends import Backend
from stss.frames.compute_options import ComputeOptions
from stss.run.choose_backend import open_method
from stss.run.frame_job import FrameJob, FrameReport, frame_name
from stss.run.options import RunOptions
from stss.run.pipeline import AHEAD
from stss.weights.file import LoadedWeights
from stss_ground.errors import DeviceError, InputError
from stss_ground.output.lock import LOCK
from stss_ground.output.write_whole import make_folder, write_part
from stss_ground.version import VERSION
from stss_ref.arrays import ArrayError
from stss_ref.schedule import FrameKind

if TYPE_CHECKING:
    from stss.sequence.reader import Sequence as Frames


@dataclass(frozen=True)
class Work:
    """A whole run, as it is sent to each worker once.

    Attributes:
        sequence: the sequence to read; the worker opens the same paths.
        rendered: the display frames that count as rendered.
        options, method, loaded, backend, compute: as for a run in one process.
        out: the run's folder, which the worker may or may not see.
        lock: the content of the folder's lock: a worker that reads the same shares the storage.
    """

    sequence: Frames
    rendered: frozenset[int]
    options: RunOptions
    method: str
    loaded: LoadedWeights
    backend: str
    compute: ComputeOptions
    out: Path
    lock: bytes


@dataclass(frozen=True)
class File:
    """A file of a frame: its place below the folder, its SHA-256, and either its bytes or the file beside its place that has them."""

    name: str
    digest: str
    data: bytes | None
    part: Path | None


@dataclass(frozen=True)
class Introduction:
    """A worker's version and its backend's name, or the reason why it cannot work."""

    version: str
    backend: str
    error: str = ""


@dataclass(frozen=True)
class Chunk:
    """The reports of a chunk's frames, each with its files, and the error that ended the chunk early, or ""."""

    frames: list[tuple[FrameReport, list[File]]]
    error: str = ""


class WorkerSink:
    """Takes a worker's files to the run's folder: beside their place on shared storage, or as bytes to the process that was started."""

    def __init__(self, path: Path, *, shared: bool):
        self._path, self._shared = path, shared
        self._files: dict[str, list[File]] = {}

    @property
    def path(self) -> Path:
        """See ``stss.run.frame_job.Sink``."""
        return self._path

    def write(self, name: str, data: bytes) -> None:
        """See ``stss.run.frame_job.Sink``."""
        digest = hashlib.sha256(data).hexdigest()
        if self._shared:
            make_folder((self.path / name).parent)
            file = File(name, digest, None, write_part(self.path / name, data))
        else:
            file = File(name, digest, data, None)
        self._files.setdefault(Path(name).stem, []).append(file)

    def take(self, number: int) -> list[File]:
        """The files of a frame, in the order in which they were written."""
        return self._files.pop(Path(frame_name(number, "exr")).stem, [])

    def drop(self) -> None:
        """Remove the files that nobody has taken."""
        for file in (file for files in self._files.values() for file in files):
            if file.part is not None:
                file.part.unlink(missing_ok=True)
        self._files.clear()


class _Line:
    """The frames of a worker, one chunk after the other, without a pause between two chunks that follow each other.

    While the last frames of a chunk are written, the first ones of the next are read and computed.
    """

    def __init__(self, job: FrameJob, sink: WorkerSink, size: tuple[int, int]):
        self._job, self._sink, self._size = job, sink, size
        self._waiting = deque[int]()
        self._begun = deque[int]()
        """Frames that were asked for or announced, without those that were reported."""
        self._reports: Generator[FrameReport, None, None] | None = None

    def run(self, numbers: Sequence[int], after: Sequence[int], frames: list[tuple[FrameReport, list[File]]]) -> None:
        """Append the report and files of each frame to ``frames``; begin with the frames of ``after`` as well."""
        if list(self._begun) != list(numbers[: len(self._begun)]):
            self.drop()
        coming = [*numbers, *after[: AHEAD + 1]][len(self._begun) :]
        self._begun.extend(coming)
        self._waiting.extend(coming)
        for _ in numbers:
            report = next(self._reports, None) if self._reports else None
            if report is None:  # nothing was announced
                self._reports = self._job.run(self._waiting, self._size)
                report = next(self._reports)
            self._begun.popleft()
            frames.append((report, self._sink.take(report.number)))
        if not self._begun:
            self.drop()

    def drop(self) -> None:
        """Forget what was announced; frames that were read stay for those that follow them."""
        if self._reports:
            self._reports.close()
        self._reports = None
        self._waiting.clear()
        self._begun.clear()
        self._sink.drop()


class Worker:
    """One run on one worker. Chunks come one at a time, whatever number of threads the worker has."""

    def __init__(self, work: Work):
        self._work = work
        self._lock = Lock()
        self._backend: Backend | None = None
        self._line: _Line | None = None

    def introduce(self) -> Introduction:
        """Open the backend; returns its name, or why it cannot be opened."""
        try:
            with self._lock:
                self._open()
                for path in self._work.sequence.files(self._work.sequence.numbers[0]):
                    if not path.is_file():
                        raise InputError(f"{path}: not there; workers read the same paths, from shared storage")
                return Introduction(VERSION, self._open().name)
        except (InputError, DeviceError, OSError) as error:
            return Introduction(VERSION, "", str(error))

    def compute(self, numbers: Sequence[int], after: Sequence[int], backends: frozenset[str]) -> Chunk:
        """Compute some frames.

        Args:
            numbers: display frames in order.
            after: the frames that this worker will probably be asked for next.
            backends: names of the backends that the run accepts: a worker that came later may have another.
        """
        with self._lock:
            backend = self._open()
            if backend.name not in backends:
                return Chunk([], f"a worker that came later computes by {backend.name}; expected {', '.join(sorted(backends))}")
            frames = list[tuple[FrameReport, list[File]]]()
            line = self._line = self._line or self._new_line(backend)
            try:
                line.run(numbers, after, frames)
            except BaseException as error:
                line.drop()
                self._line = None
                if isinstance(error, (InputError, ArrayError, DeviceError)):
                    return Chunk(frames, str(error))
                raise
            return Chunk(frames)

    def _new_line(self, backend: Backend) -> _Line:
        work = self._work
        sink = WorkerSink(work.out, shared=self._shares())
        job = FrameJob.of(work.sequence, work.rendered, work.options, backend, self._label, sink, _nothing_written)
        return _Line(job, sink, work.sequence.size)

    def _open(self) -> Backend:
        if self._backend is None:
            work = self._work
            self._backend, self._label = open_method(work.method, work.loaded, work.backend, work.compute)
        return self._backend

    def _shares(self) -> bool:
        try:
            return (self._work.out / LOCK).read_bytes() == self._work.lock
        except OSError:
            return False


def _nothing_written(number: int, key: str) -> FrameKind | None:
    """A worker keeps no frame: the process that holds the folder knows what is kept, and asks only for the rest."""
    del number, key
