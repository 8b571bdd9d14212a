# SPDX-License-Identifier: MIT
"""A run on many machines: only this process writes to the folder; workers compute chunks of frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures import TimeoutError as Timeout
from pathlib import Path

from stss.cluster.chunk import Chunk, Engine, Introduction, Work, compute_chunk, introduce
from stss.cluster.workers import Workers, connect
from stss.run.frame_job import FrameReport, already_written, describe, keep_outside, keys_of, require_one_run
from stss.run.job import REFUSAL, RunPlan, Summary, plan_run
from stss.run.options import RunOptions
from stss.run.window import Keys
from stss.sequence.sequence import Sequence as Frames
from stss_ground.errors import InputError
from stss_ground.version import VERSION

MAX_CHUNK = 48
"""Most frames of a chunk; a worker reads five more before it."""
CHUNKS_PER_WORKER = 3
"""Chunks for each worker, unless they would have fewer than `MIN_CHUNK` frames or more than `MAX_CHUNK`."""
MIN_CHUNK = 8
MAX_CHUNK_BYTES = 1 << 30
"""Most bytes of a chunk's images: worker and writer hold them in memory."""
CHUNKS_AHEAD = 2
"""Chunks for each worker that are handed out at a time."""
FIRST_TIMEOUT = 3600.0
"""Seconds until the first answer: the worker builds kernels, and its speed is unknown."""
MIN_TIMEOUT, TIMEOUT_FACTOR = 60.0, 10.0
"""Workers count as hung if no chunk arrives for these seconds and for this multiple of the slowest chunk's duration."""
MAX_FAILURES = 3
"""Most times in a row that workers may die or hang before a chunk comes in."""


def run_on_cluster(
    sequence: Frames,
    out: Path,
    address: str,
    engine: Engine,
    options: RunOptions,
    on_frame: Callable[[FrameReport], None] = lambda report: None,
    reads: Iterable[Path] = (),
) -> Summary:
    """As ``stss.run.job.run``, with the same files and the same bits.

    Args:
        sequence, out, options, on_frame, reads: as there; ``on_frame`` is called in the order in which chunks arrive.
        address: where to compute, see ``stss.cluster.workers.connect``.
        engine: computes there.

    Raises:
        InputError: as there; nothing answers at the address, workers differ, or workers die or hang again and
            again.
    """
    run_plan = plan_run(sequence, out, options, reads)
    # The workers alone know the method.
    require_one_run(run_plan.folder, options, describe(sequence, options, "", "", engine.loaded.label))
    work = Work(VERSION, sequence, run_plan.rendered, out, options, engine)
    with (
        connect(address) as workers,
        run_plan.folder.open(refusal=None if options.resume or options.overwrite else REFUSAL),
    ):
        keep_outside(run_plan.folder, options)
        summary = _Run(workers, work, run_plan, on_frame).run()
        run_plan.folder.finish(remove_others=options.overwrite)
    return summary


def cut_into_chunks(numbers: Sequence[int], workers: int, size: tuple[int, int]) -> list[list[int]]:
    """Cut display frames into chunks; ``size`` is (H, W) of the inputs, whose images have 24 bytes for each of their pixels."""
    share = math.ceil(len(numbers) / (CHUNKS_PER_WORKER * workers))
    count = max(1, min(MAX_CHUNK, max(MIN_CHUNK, share), MAX_CHUNK_BYTES // (24 * size[0] * size[1])))
    return [list(numbers[start : start + count]) for start in range(0, len(numbers), count)]


class _Run:
    """Sends chunks to workers, writes their frames, and sends a chunk again if its worker dies or hangs."""

    def __init__(self, workers: Workers, work: Work, run_plan: RunPlan, on_frame: Callable[[FrameReport], None]):
        self._workers, self._work, self._run_plan, self._on_frame = workers, work, run_plan, on_frame
        self._chunks: list[list[int]] | None = None
        """The remaining chunks; None: no worker has answered yet."""
        self._reports: dict[int, FrameReport] = {}
        self._errors: dict[int, str] = {}
        """Display frame -> why it ended its chunk."""
        self._backend = ""
        self._failures = 0
        """Times in a row that workers died or hung."""
        self._slowest: float | None = None
        """Seconds of a chunk."""

    def run(self) -> Summary:
        """Yield the report of each frame; raises the first frame's error after all frames before it are written."""
        while self._chunks is None or self._chunks:
            executor, hangs = self._workers.start(), False
            try:
                self._attempt(executor)
            except (*self._workers.deaths(), Timeout) as error:
                hangs = isinstance(error, Timeout)
                self._failures += 1
                if self._failures > MAX_FAILURES:
                    what = f"frames {self._chunks[0][0]} to {self._chunks[0][-1]}" if self._chunks else "as they began"
                    raise InputError(
                        f"--cluster: workers died or hung {self._failures} times, {what}; --resume goes on"
                    ) from error
            finally:
                self._workers.end(executor, hangs=hangs)
        if self._errors:
            raise InputError(self._errors[min(self._errors)])
        return Summary([self._reports[number] for number in sorted(self._reports)])

    def _attempt(self, executor: Executor) -> None:
        """Go on until all is done, or a worker dies or hangs. Then one chunk is sent alone, to find the one that causes it."""
        if self._chunks is None:
            self._begin(executor.submit(introduce, self._work.part(self._run_plan.numbers[:1])).result(FIRST_TIMEOUT))
        waiting, tasks = list(self._chunks or ()), dict[Future[Chunk], list[int]]()
        while self._chunks:
            while waiting and len(tasks) < (1 if self._failures else CHUNKS_AHEAD * self._workers.count()):
                numbers = waiting.pop(0)
                tasks[executor.submit(compute_chunk, self._work.part(numbers), numbers)] = numbers
            limit = FIRST_TIMEOUT if self._slowest is None else max(MIN_TIMEOUT, TIMEOUT_FACTOR * self._slowest)
            results = wait(tasks, limit, FIRST_COMPLETED).done
            if not results:
                raise Timeout
            for future in results:
                self._take(tasks.pop(future), future.result())

    def _begin(self, who: Introduction) -> None:
        """Report the frames that an earlier run finished, and cut the others into chunks."""
        if who.error:
            raise InputError(f"--cluster: a worker cannot begin: {who.error}")
        self._backend = who.backend
        todo = [*self._run_plan.numbers]
        if self._work.options.resume:  # a key is a digest of files, which may be terabytes
            work, options = self._work, self._work.options
            settings = describe(work.sequence, options, who.method, who.backend, who.weights)
            keys = keys_of(work.sequence, work.rendered, options, settings, work.engine.window)
            todo = [number for number in todo if not self._is_kept(number, keys)]
        self._chunks = cut_into_chunks(todo, self._workers.count(), self._work.sequence.size)

    def _is_kept(self, number: int, keys: Keys) -> bool:
        kind = already_written(self._run_plan.folder, self._work.options, number, keys.of(number))
        if kind is not None:
            self._report(FrameReport(number, kind, "kept"))
        return kind is not None

    def _take(self, numbers: list[int], chunk: Chunk) -> None:
        if self._chunks is None or numbers not in self._chunks:  # it arrived together with an earlier one that has an error
            return
        if chunk.backend not in ("", self._backend):
            kinds = f"{self._backend}; {chunk.backend}"
            raise InputError(f"--cluster: workers differ, and so would their bits: {kinds}")
        self._slowest = max(chunk.seconds, self._slowest or 0.0)
        for report, files in chunk.frames:
            for name, data in files.items():
                self._run_plan.folder.write(name, data)
            self._report(report)
        self._chunks.remove(numbers)
        self._failures = 0
        if chunk.error:
            first = numbers[len(chunk.frames)]
            self._errors[first] = chunk.error
            self._chunks = [others for others in self._chunks if others[0] < first]

    def _report(self, report: FrameReport) -> None:
        self._reports[report.number] = report
        self._on_frame(report)
