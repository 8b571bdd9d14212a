# SPDX-License-Identifier: MIT
"""The same seed draws the same cases for every port, wherever the judge is installed."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

_PROVIDERS = "hypothesis.internal.conjecture.providers"


@contextmanager
def no_local_constants() -> Generator[None, None, None]:
    """Within it Hypothesis draws no numbers that it found in source code.

    It looks for constants in all modules that are not installed: those of a port in Python, and ours in a checkout. It mixes them
    into what it draws, and keeps them in a folder ``.hypothesis`` where the judge was called. It has no setting for that. A version
    without these names has no such constants.
    """
    try:
        hypothesis: Any = import_module(_PROVIDERS)
    except ModuleNotFoundError:
        hypothesis = None
    if not hasattr(hypothesis, "_get_local_constants"):
        yield
        return
    kept = hypothesis._get_local_constants, hypothesis.CONSTANTS_CACHE
    none = hypothesis.Constants()
    hypothesis._get_local_constants, hypothesis.CONSTANTS_CACHE = lambda: none, {}
    try:
        yield
    finally:
        hypothesis._get_local_constants, hypothesis.CONSTANTS_CACHE = kept
