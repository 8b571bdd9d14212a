# SPDX-License-Identifier: MIT
"""Work on large arrays, block by block, on all cores."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import TypeVar

from stss_ground.machine import available_threads

Result = TypeVar("Result")


def for_blocks(length: int, block: int, work: Callable[[slice], Result]) -> list[Result]:
    """Call ``work`` with slices of ``block`` items that cover ``length``, on all cores: NumPy's loops do not hold Python's lock.

    A single block is worked on in the caller's thread, so that work within work starts no threads of its own.

    Args:
        length: of the axis that is cut.
        block: items of a slice, few enough that the work on them stays in the processor's cache.
        work: must not depend on the order of its calls.

    Returns:
        The results of the calls, in the order of the slices. The first error in this order is raised.
    """
    parts = [slice(start, min(start + block, length)) for start in range(0, length, block)]
    if len(parts) <= 1 or (threads := min(available_threads(), len(parts))) == 1:
        return [work(part) for part in parts]
    # A context cannot be entered by two threads at once. It holds the caller's np.errstate.
    calls = [(copy_context(), part) for part in parts]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(lambda call: call[0].run(work, call[1]), calls))
