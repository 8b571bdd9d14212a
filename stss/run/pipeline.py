# SPDX-License-Identifier: MIT
"""Three steps in a row on one item after the other, the steps of neighbouring items at the same time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

AHEAD = 2
"""Most items that are read ahead of the one being computed, and most of those before it that may still wait to be written."""

Item = TypeVar("Item")
Read = TypeVar("Read")
Computed = TypeVar("Computed")
Written = TypeVar("Written")


def overlap(
    items: Iterable[Item],
    read: Callable[[Item], Read],
    compute: Callable[[Read], Computed],
    write: Callable[[Computed], Written],
    done: Callable[[Written], None],
    meanwhile: Callable[[], None] = lambda: None,
) -> None:
    """Do ``done(write(compute(read(item))))`` for every item; later items are read and earlier ones written meanwhile.

    The first item has the processor to itself until it is computed: the user waits to see it.

    Each step takes the items in order. An error is raised when its item's turn comes, after the items before it are done, just as
    if items were worked on one at a time; after an item that cannot be written no other is. No thread is left when this returns or
    raises.

    Args:
        items: what to work on.
        read: runs in a thread of its own.
        compute: runs in the caller's thread.
        write: runs in a third thread.
        done: runs in the caller's thread.
        meanwhile: runs once in the caller's thread, while the first item is read.
    """
    reader, writer = ThreadPoolExecutor(1, "stss-read"), ThreadPoolExecutor(1, "stss-write")
    todo = iter(items)
    reading: deque[Future[Read]] = deque()
    writing: deque[Future[Written]] = deque()
    failed = False

    def write_in_turn(computed: Computed) -> Written:
        nonlocal failed
        if failed:
            raise CancelledError  # nobody asks: the error before it ends the work
        try:
            return write(computed)
        except BaseException:
            failed = True
            raise

    def finish(most: int) -> None:
        while len(writing) > most or (writing and writing[0].done()):
            written = writing[0].result()  # a failed one stays in the list, so that asking again raises the same error
            writing.popleft()
            done(written)

    try:
        reading.extend(reader.submit(read, item) for item in islice(todo, 1))
        meanwhile()
        while reading:
            ready = reading.popleft().result()
            finish(AHEAD - 1)
            writing.append(writer.submit(write_in_turn, compute(ready)))
            reading.extend(reader.submit(read, item) for item in islice(todo, AHEAD + 1 - len(reading)))
    finally:
        try:
            finish(0)
        finally:
            for thread in (writer, reader):
                thread.shutdown(cancel_futures=True)
