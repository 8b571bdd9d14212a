# SPDX-License-Identifier: MIT
"""Measure the time of a frame by our code and by other engines, and the error of each: `stss bench`.

Every contender, ours or a peer, has its own process, so that its memory is separate and its threads sleep while another runs.
Contenders are timed in turns, A B C A B C, so that a load on the machine slows all of them.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from stss_ground.errors import InputError
from stss_lab.bench.contender import Setup
from stss_lab.bench.ours import FRAMES, OURS, PUSH, contender, inputs_for, truth
from stss_lab.bench.peers import PEERS
from stss_ref.arrays import Image

WARM_UP = 2
"""Runs of each contender before its first timed run."""
STAGE_RUNS = 5
"""Measurements of the stages, after the timed runs."""
SUMMARY = ("wall_min", "wall_median", "cpu_min", "cpu_median")
"""Figures of a contender's runs: of wall clock, and of its process's processor time divided by the number of threads."""
PAUSE = 0.02
"""Seconds between two runs, in which the threads of the first one fall asleep."""


@dataclass(frozen=True)
class Timing:
    """The results of one contender at one size.

    Attributes:
        name: as in ``OURS`` or ``PEERS``.
        times: seconds of each run, in order.
        cpu_times: seconds of processor time that its process used in each run, divided by the number of threads. They equal ``times``
            on a quiet machine if all threads always have work.
        error: largest difference from the float64 reference on the same inputs, output units; None for a contender that failed, or
            whose image has no truth.
        peak_memory: most bytes that its process had in memory, with Python and libraries; None if the system does not say.
        stages: seconds of each stage; empty for contenders that measure none.
        details: package versions, precision, layout.
        fault: why there is no result; None if there is one.
    """

    name: str
    times: tuple[float, ...] = ()
    error: float | None = None
    peak_memory: int | None = None
    stages: dict[str, float] = field(default_factory=dict[str, float])
    details: dict[str, str] = field(default_factory=dict[str, str])
    fault: str | None = None
    cpu_times: tuple[float, ...] = ()

    @property
    def summary(self) -> dict[str, float]:
        """Seconds, by the names in ``SUMMARY``."""
        both = {"wall": self.times, "cpu": self.cpu_times}
        return {f"{kind}_{f.__name__}": f(times) for kind, times in both.items() for f in (min, statistics.median) if times}


@dataclass(frozen=True)
class SizeResult:
    """The results of all contenders at one size.

    Attributes:
        height, width: of the inputs; pixels.
        rows: one for each contender, ours first.
    """

    height: int
    width: int
    rows: tuple[Timing, ...]

    def shares(self, row: Timing) -> dict[str, float]:
        """Times of ``row`` / times of the first peer, by the names in ``SUMMARY``; empty if the two cannot be compared."""
        base = next((r for r in self.rows if r.name in PEERS and not r.fault), None)
        if base is None or row.fault or row.name in FRAMES:
            return {}
        theirs = base.summary
        return {name: seconds / theirs[name] for name, seconds in row.summary.items() if theirs.get(name)}


def bench(
    setups: Sequence[Setup],
    ours: Sequence[str],
    peers: Sequence[str],
    repeat: int,
    on_step: Callable[[str], None] = lambda _: None,
) -> tuple[SizeResult, ...]:
    """Time ``ours`` and ``peers`` for each of the setups.

    Args:
        setups: one for each size.
        ours: names in ``OURS``.
        peers: names in ``PEERS``; ratios are to the first of them.
        repeat: timed runs of each contender.
        on_step: called with a line before each step.

    Returns:
        The results of each setup.

    Raises:
        InputError: a name is unknown, or there is nothing to time.
    """
    for names, choices, what in ((ours, OURS, "ours"), (peers, PEERS, "peers")):
        for name in names:
            if name not in choices:
                raise InputError(f"{what}: expected some of {', '.join(choices)}, got {name!r}")
    names = list(dict.fromkeys([*ours, *peers]))
    if not names or repeat < 1:
        raise InputError("bench: expected at least one contender and one run")
    return tuple(_bench_size(setup, names, repeat, on_step) for setup in setups)


def count_steps(setups: Sequence[Setup], ours: Sequence[str], peers: Sequence[str], repeat: int) -> int:
    """The number of calls of ``on_step`` by `bench`."""
    return len(setups) * (1 + len({*ours, *peers}) + repeat)


def _bench_size(setup: Setup, names: Sequence[str], repeat: int, on_step: Callable[[str], None]) -> SizeResult:
    size = setup.height, setup.width
    label = f"{size[1]}x{size[0]}"
    on_step(f"{label}: float64 reference")
    kinds = {name in FRAMES: name for name in names if name != PUSH}
    truths = {whole: truth(inputs_for(name, setup), setup.weights) for whole, name in kinds.items()}
    workers = [_Worker(name, setup) for name in names]
    try:
        for worker in workers:
            on_step(f"{label}: warming up {worker.name}")
            worker.start(truths.get(worker.name in FRAMES))
        truths.clear()
        for i in range(repeat):
            on_step(f"{label}: run {i + 1} of {repeat}")
            for worker in workers:
                worker.time()
        return SizeResult(*size, tuple(worker.finish() for worker in workers))
    finally:
        for worker in workers:
            worker.stop()


class _Worker:
    """A contender's process, seen from the parent process. An error in it becomes the ``fault`` of its row."""

    def __init__(self, name: str, setup: Setup):
        self.name = name
        self._setup = setup
        self._times: list[float] = []
        self._cpu_times: list[float] = []
        self._error: float | None = None
        self._details: dict[str, str] = {}
        self._fault: str | None = None
        context = multiprocessing.get_context("spawn")  # a fork would share the threads' locks but not the threads
        self._pipe, self._other_end = context.Pipe()
        self._process = context.Process(target=serve, args=(self._other_end, name, setup), daemon=True)

    def start(self, want: Image | None) -> None:
        """Start the process, wait until the contender is ready and warm, and compare its image, if it has a truth, with ``want``."""
        self._process.start()
        self._other_end.close()
        ready = self._answer()
        if ready is not None:
            self._details, image = ready
            self._error = None if image is None or want is None else _error(image, want)

    def time(self) -> None:
        """Time one run."""
        time.sleep(PAUSE)
        if (seconds := self._ask("time")) is not None:
            self._times.append(seconds[0])
            self._cpu_times.append(seconds[1] / self._setup.threads)

    def finish(self) -> Timing:
        """The results of the contender."""
        memory, stages = self._ask("finish") or (None, {})
        if self._fault:
            return Timing(self.name, details=self._details, fault=self._fault)
        times = tuple(self._times), self._error, memory, stages, self._details
        return Timing(self.name, *times, cpu_times=tuple(self._cpu_times))

    def stop(self) -> None:
        """End the process, even one that hangs."""
        if self._process.pid is not None:
            self._process.terminate()
            self._process.join()
        self._pipe.close()

    def _ask(self, order: str) -> Any:
        """Send ``order`` and return the answer; None after a fault."""
        if self._fault:
            return None
        with contextlib.suppress(OSError):  # the process ended: _answer() says so
            self._pipe.send(order)
        return self._answer()

    def _answer(self) -> Any:
        try:
            good, answer = self._pipe.recv()
        except (EOFError, OSError):
            self._process.join()
            good, answer = False, f"its process ended with status {self._process.exitcode}"
        if good:
            return answer
        self._fault = answer
        return None


def _error(image: Image, want: Image) -> float:
    if image.shape != want.shape:
        return float("inf")
    error = float(np.abs(image - want).max())
    return error if error == error else float("inf")  # noqa: PLR0124  (NaN)


def serve(pipe: Connection, name: str, setup: Setup) -> None:
    """Run in the contender's process: make the contender, then answer each order with ``(True, result)`` or ``(False, reason)``."""
    try:
        engine = contender(name, setup)
        engine.prepare(inputs_for(name, setup))
        for _ in range(WARM_UP):
            engine.run()
        pipe.send((True, (engine.details, engine.image())))
        while pipe.recv() == "time":
            start, cpu_start = time.perf_counter(), time.process_time()
            engine.run()
            frames = getattr(engine, "frames", 1)
            pipe.send((True, ((time.perf_counter() - start) / frames, (time.process_time() - cpu_start) / frames)))
        pipe.send((True, (_peak_memory(), _stages(engine))))
    except (KeyboardInterrupt, EOFError):
        return
    except Exception as error:  # an engine may raise anything: it becomes the row's fault
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        pipe.send((False, first))


def _stages(engine: Any) -> dict[str, float]:
    """Seconds of each stage, the least of a few measurements; empty for a contender that measures none."""
    if not hasattr(engine, "timings"):
        return {}
    runs: list[dict[str, float]] = [engine.timings() for _ in range(STAGE_RUNS)]
    return {stage: min(run[stage] for run in runs) for stage in runs[0]}


def _peak_memory() -> int | None:
    """Largest resident set of this process; bytes. Not ``ru_maxrss``, since that of a child starts at its parent's value."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))
    except (OSError, StopIteration):
        return None
