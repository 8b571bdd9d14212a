# SPDX-License-Identifier: MIT
"""Measure the share of the machine that others used while something was timed."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

STAT = Path("/proc/stat")
TICKS_PER_S = 100
"""Unit of the times in /proc/stat, on every Linux (USER_HZ)."""


class Noise(NamedTuple):
    """The load of others, as shares, 0 to 1, of the time of all the machine's processors.

    Attributes:
        processes: share of other processes on this machine.
        guests: share of other guests of this machine's host.
    """

    processes: float
    guests: float

    def __str__(self) -> str:
        return f"other processes had {self.processes:.0%} of this machine, other guests of its host {self.guests:.0%}"


class ProcessorTime(NamedTuple):
    """Seconds of all processors together since the system started: ``busy``, ``stolen`` for other guests, ``all`` with the idle ones."""

    busy: float
    stolen: float
    all: float

    def noise_since(self, earlier: ProcessorTime, own: float) -> Noise:
        """The load of others between two readings.

        Args:
            earlier: the first reading; this one is the second.
            own: processor time of the timed processes in between; seconds.
        """
        whole = max(self.all - earlier.all, 1 / TICKS_PER_S)
        others = max(self.busy - earlier.busy - own, 0.0)  # the system counts in hundredths, own is exact
        return Noise(min(others / whole, 1.0), min((self.stolen - earlier.stolen) / whole, 1.0))


def processor_time(path: Path = STAT) -> ProcessorTime | None:
    """Read the times from ``path``; None where the system does not give them."""
    try:
        name, *fields = path.read_text(encoding="ascii").split("\n", 1)[0].split()
        # user, nice, system, idle, iowait, irq, softirq, steal; "user" includes the time of this machine's own guests
        user, nice, system, idle, waiting, irq, softirq, stolen = (int(field) / TICKS_PER_S for field in fields[:8])
    except (OSError, ValueError):
        return None
    busy = user + nice + system + irq + softirq
    return ProcessorTime(busy, stolen, busy + stolen + idle + waiting) if name == "cpu" else None
