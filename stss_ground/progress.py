# SPDX-License-Identifier: MIT
"""The progress of a long command: a bar on a terminal, a line after ten seconds and each minute in a log file."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from datetime import timedelta
from threading import Event, Thread
from typing import Any, Protocol, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

T = TypeVar("T")
A_MINUTE = 60.0
"""Seconds between the lines in a log file."""
TEN_SECONDS = 10.0
"""Seconds until the first of them, which says what a command waits for: kernels that are built take half a minute."""
Track = Callable[[Sequence[int]], Iterable[int]]
"""Yields the numbers that it is given, and may show how many are done: `track`, or ``iter``."""


class Advance(Protocol):
    """The function that a command calls while it works."""

    def __call__(self, text: str = "", *, done: int = 1) -> None:
        """Count finished steps, and show ``text`` beside the bar."""
        ...


@contextmanager
def show_progress(
    console: Console, total: int, unit: str = "frames", text: str = "", *, every: float = A_MINUTE
) -> Generator[Advance, None, None]:
    """Show how much is done, how fast it goes, and the time left.

    Args:
        console: where to show it.
        total: number of steps.
        unit: the name of a step.
        text: stands before the bar until the first `Advance`.
        every: seconds between the lines in a log file.

    Yields:
        The function to call whenever something is done.
    """
    start, count, label, ended = time.monotonic(), 0, text, Event()

    def report() -> None:
        wait = min(every, TEN_SECONDS)
        while not ended.wait(wait):
            wait = every
            took = time.monotonic() - start
            rate = count / took
            pace = f", {rate:.2f} {unit}/s, {timedelta(seconds=round((total - count) / rate))} left" if count > 0 else ""
            # With the elapsed time no two lines are equal: a reader of the log sees that work goes on.
            line = f"{count} of {total} {unit} in {timedelta(seconds=round(took))}{pace}" + (f": {label}" if label else "")
            console.print(line, soft_wrap=True, markup=False, highlight=False)

    bar = _bar(console, unit)
    # Older versions of Rich end a bar that is disabled with an empty line.
    with bar if console.is_interactive else nullcontext():
        task = bar.add_task(text, total=total)

        def advance(text: str = "", *, done: int = 1) -> None:
            nonlocal count, label
            count, label = count + done, text
            bar.update(task, advance=done, description=text)

        lines = None if console.is_interactive else Thread(target=report, daemon=True)
        if lines:
            lines.start()
        try:
            yield advance
        finally:
            ended.set()
            if lines:  # its last line must be printed before the next message
                lines.join()


@contextmanager
def show_steps(console: Console, total: int) -> Generator[Callable[[str], None], None, None]:
    """As `show_progress`, of ``total`` steps; yields the function to call with the name of each step as it begins."""
    with show_progress(console, total, "steps") as advance:
        count = 0

        def begin(text: str) -> None:
            nonlocal count
            advance(text, done=min(count, 1))
            count += 1

        yield begin
        advance(done=min(count, 1))


def track(items: Sequence[T], console: Console, unit: str = "frames", text: str = "") -> Iterator[T]:
    """Yield the items, and show how many are done; see `show_progress`."""
    with show_progress(console, len(items), unit, text) as advance:
        for item in items:
            yield item
            advance(text)


def _bar(console: Console, unit: str) -> Progress:
    class Rate(TextColumn):
        def __init__(self) -> None:
            super().__init__("{task.speed}")

        def render(self, task: Any) -> Any:
            self.text_format = "" if not task.speed else f"{task.speed:.2f} {unit}/s"
            return super().render(task)

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(), MofNCompleteColumn(), Rate(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
        console=console,
        transient=True,
    )  # fmt: skip
