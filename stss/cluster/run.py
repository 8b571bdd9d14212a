# SPDX-License-Identifier: MIT
"""A run on many machines: this process holds the folder, its lock and its list; workers compute the frames."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from stss.baselines.registry import ACCUMULATING
from stss.cluster.chunks import Lanes
from stss.cluster.client import Crew, connected, crew, distributed
from stss.cluster.worker import Chunk, File, Introduction, Work, Worker
from stss.frames.compute_options import ComputeOptions
from stss.run.frame_job import FrameReport, already_written, describe, keys_of
from stss.run.job import REFUSAL, RunPlan, Summary, plan, require_unread
from stss.run.options import RunOptions
from stss.sequence.reader import Sequence as Frames
from stss.weights.file import LoadedWeights
from stss_ground.errors import InputError
from stss_ground.output.folder import OutputFolder
from stss_ground.output.lock import LOCK
from stss_ground.version import VERSION

PATIENCE = 10.0
"""How many times as long as the slowest chunk so far a chunk may take before another worker gets it as well."""
SHORTEST = 60.0
"""Seconds that a chunk may always take: the first one builds kernels."""
MOST_DEATHS = 3
"""How many workers may end with a chunk."""


@dataclass(frozen=True)
class Cluster:
    """The user's choices about the cluster.

    Attributes:
        address: ``local:N`` for N processes here, or a scheduler's, such as ``tcp://host:8786``.
        mixed: accept workers whose backends differ, and so the bits of their frames.
        shortest: see `SHORTEST`.
    """

    address: str
    mixed: bool = False
    shortest: float = SHORTEST


def run_on_cluster(
    sequence: Frames,
    out: Path,
    cluster: Cluster,
    method: str,
    loaded: LoadedWeights,
    backend: str,
    compute: ComputeOptions,
    options: RunOptions,
    on_frame: Callable[[FrameReport], None] = lambda report: None,
    reads: Iterable[Path] = (),
) -> Summary:
    """As ``stss.run.job.run``, with the same files and the same bits.

    Args:
        sequence, out, options, on_frame, reads: as there; ``on_frame`` is called in the order in which chunks arrive.
        cluster: where to compute.
        method, loaded, backend, compute: see ``stss.run.choose_backend.open_method``.

    Raises:
        InputError: as there; nothing answers at the address, workers differ, or every worker that computes a chunk dies.
    """
    planned = plan(sequence, out, options)
    require_unread(planned, sequence, reads)
    with (
        connected(cluster.address) as client,
        planned.folder.opened(refusal=None if options.resume or options.overwrite else REFUSAL),
    ):
        lock = (planned.folder.path / LOCK).read_bytes()
        work = Work(
            sequence, planned.rendered, options, method, loaded, backend, compute, planned.folder.path.absolute(), lock
        )  # fmt: skip
        with crew(client, partial(Worker, work)) as workers:
            summary = _Coordinator(workers, work, planned, cluster, on_frame).run()
        planned.folder.finish(remove_others=options.overwrite)
    return summary


def require_independent(method: str, budget: float | None) -> None:
    """Raise InputError where an output depends on earlier outputs, or on this machine's speed: then a run cannot be cut."""
    if budget is not None:
        raise InputError("--cluster: expected no --budget: a time is one machine's")
    if method in ACCUMULATING:
        raise InputError(f"--cluster: --method {method} makes each output from all before it, so a run cannot be cut")


@dataclass
class _Task:
    """A chunk that a worker was given: the worker's address, and when it began, in seconds of ``time.monotonic``."""

    numbers: Sequence[int]
    worker: str
    since: float


class _Coordinator:
    """Hands out chunks, takes their files into the folder, and hands them out again where a worker dies or does not answer."""

    def __init__(self, crew: Crew, work: Work, planned: RunPlan, cluster: Cluster, on_frame: Callable[[FrameReport], None]):
        self._crew, self._work, self._planned, self._cluster = crew, work, planned, cluster
        self._on_frame = on_frame
        self._backends = self._introduced()
        self._reports: dict[int, FrameReport] = {}
        self._tasks: dict[Any, _Task] = {}
        """By dask's future. A worker has one, or more if another worker's has come to it."""
        self._lanes = Lanes(())
        self._deaths = Counter[int]()
        """First frame of a chunk -> how many workers ended with it."""
        self._slowest = 0.0
        self._errors: dict[int, str] = {}
        """First frame of a chunk that ended early -> its error."""

    def run(self) -> Summary:
        """All chunks; raises the error of the first frame that has one, after all before it are written."""
        self._lanes = Lanes(self._keep())
        self._employ()
        while self._lanes.left() or any(not self._is_done(task) for task in self._tasks.values()):
            for future in self._finished():
                if future in self._tasks:  # else an error that came in just before has dropped it
                    self._receive(future)
            self._again()
            self._employ()
        for future in self._tasks:
            future.cancel()
        if self._errors:
            raise InputError(self._errors[min(self._errors)])
        return Summary([self._reports[number] for number in sorted(self._reports)])

    def _introduced(self) -> frozenset[str]:
        """Names of the workers' backends."""
        found: dict[str, Introduction] = self._crew.introductions()
        for address, who in found.items():
            if who.error:
                raise InputError(f"worker {address}: {who.error}")
            if who.version != VERSION:
                raise InputError(f"worker {address}: expected stss {VERSION}, as here, found {who.version}")
        names = sorted({who.backend for who in found.values()})
        if len(names) > 1 and not self._cluster.mixed:
            raise InputError(
                f"--cluster: workers differ, and so would their bits: {'; '.join(names)}; --mixed-devices takes them"
            )
        return frozenset(names)

    def _keep(self) -> list[int]:
        """Report the frames that an earlier run finished; returns the others, which are still to be done."""
        work, options = self._work, self._work.options
        if not options.resume:
            return list(self._planned.numbers)
        described = [describe(work.sequence, options, work.method, name, work.loaded.label) for name in self._backends]
        keys = [keys_of(work.sequence, work.rendered, options, one) for one in described]
        todo: list[int] = []
        for number in self._planned.numbers:
            found = (already_written(self._planned.folder, options, number, one.of(number)) for one in keys)
            kind = next((kind for kind in found if kind is not None), None)
            if kind is None:
                todo.append(number)
            else:
                self._report(FrameReport(number, kind, "kept"))
        return todo

    def _employ(self) -> None:
        """Give each worker that has no chunk its next one."""
        addresses = self._crew.addresses()
        for future, task in list(self._tasks.items()):
            if task.worker not in ("", *addresses):
                self._withdraw(future)
        busy = {task.worker for task in self._tasks.values()}
        for address in addresses:
            if address not in busy:
                self._give(address)

    def _give(self, address: str) -> None:
        if numbers := self._lanes.take(address):
            after = self._lanes.after(address)
            future = self._crew.submit("compute", numbers, after, self._backends, workers=[address], others=True)
            self._tasks[future] = _Task(numbers, address, time.monotonic())

    def _withdraw(self, future: Any) -> None:
        """A worker has ended. Dask would give its chunk to one that has work of its own."""
        future.cancel()
        task = self._tasks.pop(future)
        if self._is_done(task):
            return
        self._deaths[task.numbers[0]] += 1
        if self._deaths[task.numbers[0]] > MOST_DEATHS:
            raise _killed(task.numbers, task.worker)
        self._lanes.end(task.worker, task.numbers)

    def _is_done(self, task: _Task) -> bool:
        """Whether nothing that the run needs is missing of it."""
        end = min(self._errors, default=task.numbers[-1] + 1)
        return all(number in self._reports for number in task.numbers if number < end)

    def _finished(self) -> Iterable[Any]:
        self._crew.require_some()
        if not self._tasks:
            time.sleep(1)  # for a worker to come
            return ()
        with suppress(distributed().TimeoutError):  # asyncio's before Python 3.11
            return distributed().wait(list(self._tasks), timeout=1, return_when="FIRST_COMPLETED").done
        return ()

    def _receive(self, future: Any) -> None:
        """Take a chunk that has come in; its worker goes on meanwhile."""
        task = self._tasks.pop(future)
        numbers = task.numbers
        try:
            chunk: Chunk = future.result()
        except distributed().KilledWorker as error:
            raise _killed(numbers, error.last_worker.address) from error
        if chunk.error and not self._is_done(task):
            self._errors[numbers[len(chunk.frames)]] = chunk.error
            self._drop_later()
        elif all(task.worker != other.worker for other in self._tasks.values()):
            self._give(task.worker)
        self._slowest = max(self._slowest, (time.monotonic() - task.since) / len(numbers))
        for report, files in chunk.frames:
            new = report.number not in self._reports
            for file in files:
                _place(self._planned.folder, file, new=new)
            if new:
                self._report(report)

    def _report(self, report: FrameReport) -> None:
        self._reports[report.number] = report
        self._on_frame(report)

    def _drop_later(self) -> None:
        """Drop the chunks after the first error; those before it are still computed."""
        first = min(self._errors)
        self._lanes.drop(first)
        for future, task in list(self._tasks.items()):
            if task.numbers[0] > first:
                future.cancel()
                del self._tasks[future]

    def _again(self) -> None:
        """Give a chunk that takes too long to another worker as well. The first worker gets no other until it answers or dies."""
        where: dict[str, Any] = self._crew.client.processing()
        for future, task in list(self._tasks.items()):
            holder = next((address for address, keys in where.items() if future.key in keys), None)
            if self._is_done(task):
                if holder != task.worker:
                    future.cancel()
                    del self._tasks[future]
                continue
            copies = sum(other.numbers is task.numbers for other in self._tasks.values())
            limit = max(self._cluster.shortest, PATIENCE * self._slowest * len(task.numbers))
            if holder is None:  # it waits for its turn
                task.since = time.monotonic()
            elif copies == 1 and len(where) > 1 and time.monotonic() - task.since > limit:
                others = [address for address in where if address != holder]
                again = self._crew.submit("compute", task.numbers, (), self._backends, workers=others)
                self._tasks[again] = _Task(task.numbers, "", time.monotonic())


def _killed(numbers: Sequence[int], worker: str) -> InputError:
    return InputError(f"frames {numbers[0]} to {numbers[-1]}: every worker that computed them ended, {worker} last")


def _place(folder: OutputFolder, file: File, *, new: bool) -> None:
    if not new:
        if file.part is not None:
            file.part.unlink(missing_ok=True)
    elif file.part is not None:
        folder.adopt(file.name, file.part, file.digest)
    else:
        assert file.data is not None
        folder.write(file.name, file.data)
