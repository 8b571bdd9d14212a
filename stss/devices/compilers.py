# SPDX-License-Identifier: MIT
"""Processes that compile the kernels of a self-test on idle processors: they begin at different ones and share the compiler's cache."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from stss.devices import child
from stss_ground.machine import available_threads

COMMAND = (sys.executable, "-m", "stss.devices.compile_ahead")
MOST = 3
"""Most processes, of 300 MiB each: with more the self-test, whose own kernels take a quarter of the time, would wait no less."""


def idle_processors() -> int:
    """Processors that this process may use and that have nothing to do now; at most ``MOST``."""
    busy = 1
    with suppress(OSError, LookupError, ValueError):  # Linux says; the loads before it are means of minutes
        busy = int(Path("/proc/loadavg").read_text().split()[3].split("/")[0])
    return max(0, min(MOST, available_threads() - busy))


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
