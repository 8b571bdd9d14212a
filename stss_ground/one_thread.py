# SPDX-License-Identifier: MIT
"""One thread of linear algebra, for the judge."""

import os


def take_one_thread() -> None:
    """Let NumPy, which is not yet imported, use one thread: idle threads spin, and for small matrices two take 1.5 times as long."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
