# SPDX-License-Identifier: MIT
"""Frames that were begun and are not yet finished, and a sequence of frames computed one ahead."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import pyopencl as cl

from stss_cl.cost import Cost
from stss_cl.device.buffers import Outgoing
from stss_cl.skip.display_frame import DisplayFrame

Call = tuple[Sequence[DisplayFrame], Sequence[int]]
"""The first two arguments of a stream: window and steps."""


@dataclass(frozen=True)
class FrameInFlight:
    """A frame whose launches and downloads are enqueued.

    Attributes:
        image, valid: see ``stss_cl.skip.stream.Stream.__call__``; not complete before ``finish``.
        coming: the transfers or commands that they wait for; finish them before they are dropped: a drop would wait, and block all
            threads of Python.
        cost: the cost of the frame.
    """

    image: Any
    valid: Any
    coming: tuple[Outgoing | cl.CommandQueue, ...]
    cost: Cost

    def finish(self) -> tuple[Any, Any]:
        """Wait for image and mask."""
        for each in self.coming:
            each.finish()
        return self.image, self.valid


def one_ahead(
    calls: Iterable[Call], begin: Callable[..., FrameInFlight], finish: Callable[[FrameInFlight], tuple[Any, Any]]
) -> Iterator[tuple[Any, Any]]:
    """Begin each call before the previous one is finished and returned.

    An error of a call, or of getting it, is raised when its turn comes. No frame is left unfinished when this ends, raises
    or is closed.
    """
    rest, waiting, newest = iter(calls), None, None
    try:
        while True:
            fault = None
            try:
                if (call := next(rest, None)) is not None:
                    newest = begin(*call)
            except Exception as error:
                fault = error
            if waiting is not None:
                yield finish(waiting)
            waiting, newest = newest, None  # do not hold the previous image while the next frame begins
            if fault is not None:
                raise fault
            if waiting is None:
                return
    finally:
        for each in (waiting, newest):
            if each is not None:
                each.finish()
