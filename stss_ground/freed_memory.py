# SPDX-License-Identifier: MIT
"""Freed memory stays with the process, for programs that compute one array of megabytes after the other."""

import ctypes
from contextlib import suppress

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Numbers of ``malloc.h``."""
MOST = 2**31 - 1


def keep_freed_memory() -> None:
    """Let glibc keep freed memory for the next array; other C libraries are not changed.

    By itself it gives large arrays back to the kernel, which clears every page anew: a third of the reference's time on large frames.
    """
    with suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        for option in (M_TRIM_THRESHOLD, M_MMAP_THRESHOLD):
            mallopt(option, MOST)
