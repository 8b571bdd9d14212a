# SPDX-License-Identifier: MIT
"""Watch whether the processes of a self-test have used up their time."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

CLOCK = 5
"""Factor by which the wall-clock time may exceed the limit of processor time: no usable machine is busier."""
IDLE = 60.0
"""Seconds of wall-clock time, or fewer if the limit is lower, in which a test must use a hundredth of a processor: a hung one uses none."""
POLL = 0.25
"""Seconds between two looks."""


def processor_seconds(session: int) -> float | None:
    """Processor time of a session's processes and of those that they waited for; seconds. None where the system does not say."""
    ticks, any_process = 0, False
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has ended
            fields = path.read_text(errors="replace").rpartition(")")[2].split()
            if int(fields[3]) == session:
                ticks, any_process = ticks + sum(map(int, fields[11:15])), True
    return ticks / os.sysconf("SC_CLK_TCK") if any_process else None


class Watch:
    """Watches a session of processes.

    Its clock stands still where this process stands still, too: a suspended job or virtual machine, a container that is paused.

    Args:
        session: the number of the session.
        limit: most processor time; seconds.
        clock: the wall-clock time; seconds.
        used: the processor time of a session, see `processor_seconds`.
    """

    def __init__(
        self,
        session: int,
        limit: float,
        clock: Callable[[], float] = time.monotonic,
        used: Callable[[int], float | None] = processor_seconds,
    ):
        self._session, self._limit, self._idle = session, limit, min(IDLE, limit)
        self._clock, self._used = clock, used
        self._last = clock()
        self._now = self._active = self._seconds = 0.0

    def over(self) -> str:
        """The reason to end it; "" if it may go on."""
        last, self._last = self._last, self._clock()
        self._now += min(self._last - last, 4 * POLL)
        if self._now > CLOCK * self._limit:
            return f"no answer within {CLOCK * self._limit:g} s"
        seconds = self._used(self._session)
        if seconds is None:
            return ""
        if seconds > self._limit:
            return f"no answer within {self._limit:g} s of processor time"
        if abs(seconds - self._seconds) > self._idle / 100:  # less: one of them ended
            self._seconds, self._active = seconds, self._now
        return f"no answer, and idle for {self._idle:g} s" if self._now - self._active > self._idle else ""
