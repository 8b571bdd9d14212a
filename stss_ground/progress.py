# SPDX-License-Identifier: MIT
"""How far a long command is: a bar on a terminal, a line a minute in a log file."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, Protocol, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

T = TypeVar("T")
A_MINUTE = 60
"""Seconds between the lines in a log file."""


class Advance(Protocol):
    """What a command calls while it works."""

    def __call__(self, text: str = "", *, done: int = 1) -> None:
        """Count what is done, and show ``text`` beside the bar."""
        ...


@contextmanager
def show_progress(
    console: Console, total: int, unit: str = "frames", text: str = "", *, clock: Callable[[], float] = time.monotonic
) -> Generator[Advance, None, None]:
    """Show how much is done, how fast it goes, and the time left.

    Args:
        console: where to show it.
        total: of what will be done.
        unit: what is counted.
        text: stands before the bar until the first `Advance`.
        clock: seconds, growing.

    Yields:
        The function to call whenever something is done.
    """
    start = last = clock()
    count = 0
    with _bar(console, unit) as bar:
        task = bar.add_task(text, total=total)

        def advance(text: str = "", *, done: int = 1) -> None:
            nonlocal count, last
            count += done
            bar.update(task, advance=done, description=text)
            now = clock()
            if not console.is_terminal and count and now - last >= A_MINUTE:
                last, rate = now, count / (now - start)
                left = timedelta(seconds=round((total - count) / rate))
                console.print(f"{count} of {total} {unit}, {rate:.2f} {unit}/s, {left} left", highlight=False)

        yield advance


def track(items: Sequence[T], console: Console, unit: str = "frames") -> Iterator[T]:
    """Yield the items, and show how many are done; see `show_progress`."""
    with show_progress(console, len(items), unit) as advance:
        for item in items:
            yield item
            advance()


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
        disable=not console.is_terminal,
    )  # fmt: skip
