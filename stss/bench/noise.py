# SPDX-License-Identifier: MIT
"""How much of the machine others had while something was timed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

STAT = Path("/proc/stat")
TICKS_PER_S = 100
"""Of /proc/stat, on every Linux (USER_HZ)."""


class Noise(NamedTuple):
    """Shares, 0 to 1, of all the time that all the machine's processors had: other processes here, and other guests of its host."""

    processes: float
    guests: float

    def __str__(self) -> str:
        return f"other processes had {self.processes:.0%} of this machine, other guests of its host {self.guests:.0%}"


@dataclass(frozen=True)
class ProcessorTime:
    """What the system has counted since it started, of all processors together, seconds.

    Attributes:
        busy: what processes and the kernel have had.
        stolen: what the host gave to other guests.
        all: these, and what was idle.
    """

    busy: float
    stolen: float
    all: float

    def noise_since(self, earlier: ProcessorTime, own: float) -> Noise:
        """What others had between the two readings, where the processes timed had ``own`` seconds."""
        whole = max(self.all - earlier.all, 1 / TICKS_PER_S)
        others = max(self.busy - earlier.busy - own, 0.0)  # it counts in hundredths, ours is exact
        return Noise(min(others / whole, 1.0), min((self.stolen - earlier.stolen) / whole, 1.0))


def processor_time(path: Path = STAT) -> ProcessorTime | None:
    """A reading; None where the system does not say."""
    try:
        name, *fields = path.read_text(encoding="ascii").split("\n", 1)[0].split()
        # user, nice, system, idle, iowait, irq, softirq, steal; what guests of this machine had stands in user already
        user, nice, system, idle, waiting, irq, softirq, stolen = (int(field) / TICKS_PER_S for field in fields[:8])
    except (OSError, ValueError):
        return None
    busy = user + nice + system + irq + softirq
    return ProcessorTime(busy, stolen, busy + stolen + idle + waiting) if name == "cpu" else None
