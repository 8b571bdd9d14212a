# SPDX-License-Identifier: MIT
"""How a property of the suite is written: a function of the judge and of one case."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from importlib import import_module
from typing import Any

from hypothesis import strategies as st

from conformance.judge import Body, Judge
from conformance.rehearsal import rehearse


def cases(strategy: st.SearchStrategy[Any], *, dear: bool = False) -> Callable[[Body], Callable[[Judge], None]]:
    """Make a test of a property: it is run on many cases of ``strategy``, as many as the judge's tier says.

    Args:
        strategy: of the cases.
        dear: whether one runs the network, so that there can be fewer.
    """

    def decorate(body: Body) -> Callable[[Judge], None]:
        @wraps(body)
        def test(judge: Judge) -> None:
            rehearse(judge, strategy, body, dear=dear)
            judge.for_all(strategy, body, dear=dear)

        # pytest looks for fixtures in the signature: the case is none.
        del test.__wrapped__  # pyright: ignore[reportAttributeAccessIssue]
        test.property = body  # pyright: ignore[reportAttributeAccessIssue]
        return test

    return decorate


def find_property(test: str) -> Body:
    """The property of a test by its id, ``stage.test``.

    Raises:
        LookupError: there is none.
    """
    stage, _, name = test.partition(".")
    try:
        return getattr(import_module(f"conformance.suite.test_{stage}"), f"test_{name}").property
    except (ImportError, AttributeError) as error:
        raise LookupError(f"no such test: {test}") from error
