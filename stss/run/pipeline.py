# SPDX-License-Identifier: MIT
"""Take items through three steps, one item after the other; the steps of neighbouring items run at the same time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from typing import TypeVar

FRAMES_AHEAD = 2
"""Most items that are read ahead of the one being computed, and most earlier items that may still wait to be written."""

Item = TypeVar("Item")
Input = TypeVar("Input")
Result = TypeVar("Result")
Report = TypeVar("Report")


def overlap(
    items: deque[Item],
    read: Callable[[Item], Input],
    compute: Callable[[Input], Result],
    write: Callable[[Result], Report],
    meanwhile: Callable[[], None] = lambda: None,
) -> Generator[Report, None, None]:
    """Do ``write(compute(read(item)))`` for every item; later items are read and earlier ones written meanwhile.

    Until the first item is computed no other runs: the user waits to see it.

    Each step takes the items in order. An error is raised when its item's turn comes, after the items before it are done, just as
    if items were worked on one at a time; after an item that cannot be written no other is. No thread is left when this ends, raises
    or is closed; results by then are written.

    Args:
        items: each is taken from the list when it is read. More may be added as long as this has not ended.
        read: runs in a thread of its own.
        compute: runs in the caller's thread, while the caller waits for the next result.
        write: runs in a third thread.
        meanwhile: runs once in the caller's thread, while the first item is read.

    Yields:
        The results of ``write``, in order.
    """
    reader, writer = ThreadPoolExecutor(1, "stss-read"), ThreadPoolExecutor(1, "stss-write")
    reading: deque[Future[Input]] = deque()
    writing: deque[Future[Report]] = deque()
    has_failed = False

    def write_in_turn(result: Result) -> Report:
        nonlocal has_failed
        if has_failed:
            raise CancelledError  # its result is not read: the error before it ends the work
        try:
            return write(result)
        except BaseException:
            has_failed = True
            raise

    def begin_to_read(most: int) -> None:
        while items and len(reading) < most:
            reading.append(reader.submit(read, items.popleft()))

    def finished(most: int) -> Generator[Report, None, None]:
        while len(writing) > most or (writing and writing[0].done()):
            result = writing[0].result()  # a failed one stays in the list, so that asking again raises the same error
            writing.popleft()
            yield result

    try:
        begin_to_read(1)
        meanwhile()
        while reading:
            try:
                ready = reading.popleft().result()
                yield from finished(FRAMES_AHEAD - 1)
                result = compute(ready)
            except (Exception, KeyboardInterrupt):
                yield from finished(0)
                raise
            writing.append(writer.submit(write_in_turn, result))
            begin_to_read(FRAMES_AHEAD + 1)
        yield from finished(0)
    finally:
        reader.shutdown(cancel_futures=True)
        writer.shutdown()
