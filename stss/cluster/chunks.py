# SPDX-License-Identifier: MIT
"""Share a run out: a worker takes chunks that follow each other, since an output depends on six display frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

CHUNK = 8
"""Frames of a chunk: what is lost where a worker dies. A chunk that follows a worker's last one costs nothing more; any other reads five
frames more than it writes."""


class Lanes:
    """The chunks that are left, in order, in a lane for each worker that has asked.

    A worker whose lane is empty gets the second half of the longest one. So workers may come at any time, and all end together.
    """

    def __init__(self, numbers: Sequence[int]):
        """Cut ``numbers``, display frames in order, into chunks."""
        chunks = deque(numbers[start : start + CHUNK] for start in range(0, len(numbers), CHUNK))
        self._lanes: dict[str, deque[Sequence[int]]] = {"": chunks}
        """"" is nobody's; who takes from it takes all."""

    def take(self, worker: str) -> Sequence[int]:
        """The worker's next chunk; empty: nothing is left."""
        lane = self._lanes.get(worker)
        if not lane:
            lane = self._lanes[worker] = self._more()
        return lane.popleft() if lane else ()

    def after(self, worker: str) -> Sequence[int]:
        """The chunk that the worker will probably take next: that of its lane."""
        lane = self._lanes.get(worker)
        return lane[0] if lane else ()

    def left(self) -> bool:
        """Whether there is a chunk that nobody has taken."""
        return any(self._lanes.values())

    def end(self, worker: str, chunk: Sequence[int]) -> None:
        """Take the lane from a worker that has ended, and put the chunk back that it did not do."""
        self._lanes[""].extend((chunk, *self._lanes.pop(worker, ())))

    def drop(self, number: int) -> None:
        """Drop the chunks that begin after display frame ``number``."""
        for worker, lane in self._lanes.items():
            self._lanes[worker] = deque(chunk for chunk in lane if chunk[0] <= number)

    def _more(self) -> deque[Sequence[int]]:
        longest = self._lanes[""] or max(self._lanes.values(), key=len)
        count = len(longest) if longest is self._lanes[""] else (len(longest) + 1) // 2
        return deque([longest.pop() for _ in range(count)][::-1])
