# SPDX-License-Identifier: MIT
"""How a property of the suite is written: a function of the judge and of one case."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from typing import Any

from hypothesis import strategies as st

from conformance.judge import Judge

Body = Callable[[Judge, Any], None]


def cases(strategy: st.SearchStrategy[Any], *, dear: bool = False) -> Callable[[Body], Callable[[Judge], None]]:
    """Make a test of a property: it is run on many cases of ``strategy``, as many as the judge's tier says.

    Args:
        strategy: of the cases.
        dear: whether one runs the network, so that there can be fewer.
    """

    def decorate(body: Body) -> Callable[[Judge], None]:
        @wraps(body)
        def test(judge: Judge) -> None:
            judge.for_all(strategy, partial(body, judge), dear=dear)

        # pytest looks for fixtures in the signature: the case is none.
        del test.__wrapped__  # pyright: ignore[reportAttributeAccessIssue]
        return test

    return decorate
