# SPDX-License-Identifier: MIT
"""Compile the kernels of a self-test on idle processors, by processes that begin at different ones and share the compiler's cache."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from stss.devices import child
from stss.devices.trial import SIZE, trial_weights

COMMAND = (sys.executable, "-m", "stss.devices.compile_ahead")
MOST = 7
"""Most processes: each starts an interpreter and a compiler, and the longest kernel takes a tenth of the time of all."""


def idle_processors() -> int:
    """Processors that this process may use and that have nothing to do now; at most ``MOST``."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    busy = 1
    with suppress(OSError, LookupError, ValueError):  # Linux says; the loads before it are means of minutes
        busy = int(Path("/proc/loadavg").read_text().split()[3].split("/")[0])
    return max(0, min(MOST, usable - busy))


@contextmanager
def compilers(name: str, trial: str, count: int, command: Sequence[str] = COMMAND) -> Generator[None]:
    """Within the block ``count`` processes compile for a device and a trial; kernels that they have not begun by its end are left out.

    ``command`` begins one; device, trial and the share of the kernels from which it goes back are appended.
    """
    children = [child.start([*command, name, trial, str((i + 1) / count)], subprocess.DEVNULL) for i in range(count)]
    try:
        yield
    finally:
        for each in children:
            child.kill(each)


def main() -> None:
    """Compile for the device, the trial and the share of the command line. Faults are left to the self-test."""
    from stss_cl.device.discovery import open_device
    from stss_cl.skip.stream import Stream

    name, trial, back_from = sys.argv[1:]
    Stream(trial_weights(trial), open_device(name)).expect(SIZE, float(back_from))


if __name__ == "__main__":
    main()
