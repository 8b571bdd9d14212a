"""``make test`` is for every commit; ``make test-thorough`` adds what has the mark ``thorough``, two thirds of the time."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def thorough(*values: Any) -> Any:
    """A parameter that the thorough tests alone try."""
    return pytest.param(*values, marks=pytest.mark.thorough)


def every(step: int, values: Iterable[Any]) -> list[Any]:
    """Values of one parameter: each ``step``-th, from the first, is tried on every commit, the others by the thorough tests."""
    return [thorough(value) if i % step else value for i, value in enumerate(values)]
