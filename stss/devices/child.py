# SPDX-License-Identifier: MIT
"""Child processes that a fault of a driver may end, and that end with all that they started."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from stss_cl.device.caches import home

_PACKAGE = Path(__file__).parents[1]


def start(command: Sequence[str], output: int) -> subprocess.Popen[str]:
    """Start one in a session of its own; ``output`` is `subprocess`' ``PIPE`` or ``DEVNULL``."""
    return subprocess.Popen(
        command,
        cwd=_PACKAGE.parent,  # -m takes modules from the working directory first, and the user's may hold anything
        env={**os.environ, "XDG_CACHE_HOME": str(home())},  # this process uses its kernels, also from a temporary folder
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        text=True,
        errors="replace",
        start_new_session=True,
    )


def kill(child: subprocess.Popen[str]) -> None:
    """End the child and all that it started, whether or not it ended by itself."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(child.pid, signal.SIGKILL)
    elif child.poll() is None:
        child.kill()
    with suppress(subprocess.TimeoutExpired):  # a process that the driver holds inside the kernel cannot be ended
        child.wait(timeout=5)
