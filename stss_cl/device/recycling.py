# SPDX-License-Identifier: MIT
"""Memory of the host that is used again: fresh memory costs a page fault for each of its pages when it is first written."""

from __future__ import annotations

import math
import weakref
from collections import deque
from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

Block = NDArray[np.uint8]


class Recycler:
    """Blocks of the host's memory. Any thread may take one or give one back.

    Args:
        make: makes a block of a number of bytes.
        most: unused blocks that are kept; of more, those that were not taken for the longest time go.
    """

    def __init__(self, make: Callable[[int], Block], most: int):
        self._make = make
        self._free: deque[Block] = deque(maxlen=most)  # whose operations are atomic: a finalizer may run at any place

    def take(self, size: int) -> Block:
        """A block of ``size`` bytes, with any content."""
        for _ in range(len(self._free)):
            try:
                block = self._free.pop()
            except IndexError:
                break
            if block.nbytes == size:
                return block
            self._free.appendleft(block)
        return self._make(size)

    def give_back(self, block: Block) -> None:
        """Give a block back; the caller must not use it afterwards."""
        self._free.append(block)

    def array(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        """An array, with any content, for the caller; its memory is taken again once the caller has dropped it and all its views."""
        count = math.prod(shape)
        block = self.take(dtype.itemsize * count)
        memory: Any = block
        array = np.frombuffer(memoryview(memory), dtype, count).reshape(shape)
        whole: Any = array.base
        weakref.finalize(whole, self.give_back, block).atexit = False
        return array


_by_context: WeakKeyDictionary[cl.Context, Recycler] = WeakKeyDictionary()


def recycler_of(context: cl.Context) -> Recycler:
    """The memory of the arrays that a processor's kernels write in place; kept as long as the context."""
    if context not in _by_context:
        _by_context[context] = Recycler(lambda size: np.empty(size, np.uint8), most=8)
    return _by_context[context]
