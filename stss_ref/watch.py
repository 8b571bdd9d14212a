# SPDX-License-Identifier: MIT
"""Record what a stage computes on its way, for callers that ask for it: the network's inputs and its layers."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar

from stss_ref.arrays import Array, Image
from stss_ref.weights import Tensors

P = ParamSpec("P")
T = TypeVar("T")


@dataclass
class Seen:
    """What was computed.

    Attributes:
        arrays: by name, in the order of computation; of a layer that ran for each of the three earlier frames, three.
        last: the name that came last.
    """

    arrays: dict[str, list[Array]] = field(default_factory=dict[str, list[Array]])
    last: str = ""

    def note(self, name: str, array: Array) -> None:
        """One more."""
        self.arrays.setdefault(name, []).append(array)
        self.last = name


_seen: ContextVar[Seen | None] = ContextVar("seen", default=None)


@contextmanager
def watched() -> Generator[Seen]:
    """Note what is computed while this is open; otherwise nothing is kept."""
    seen = Seen()
    token = _seen.set(seen)
    try:
        yield seen
    finally:
        _seen.reset(token)


def layer(
    compute: Callable[Concatenate[Image, Tensors, str, P], Image],
) -> Callable[Concatenate[Image, Tensors, str, P], Image]:
    """Let a function of input, weights and the layer's name be seen: its result, under that name."""

    @wraps(compute)
    def noted(x: Image, weights: Tensors, name: str, *rest: P.args, **named: P.kwargs) -> Image:
        y = compute(x, weights, name, *rest, **named)
        if (seen := _seen.get()) is not None:
            seen.note(name, y)
        return y

    return noted


def activation(compute: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """The same of what follows a layer: its result takes the place of what it is done to."""

    @wraps(compute)
    def noted(x: Array) -> Array:
        y = compute(x)
        if (seen := _seen.get()) is not None and seen.last and seen.arrays[seen.last][-1] is x:
            seen.arrays[seen.last][-1] = y
        return y

    return noted


def part(*names: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """The same of a function's result: an array under one name, or attributes of these names."""

    def decorate(compute: Callable[P, T]) -> Callable[P, T]:
        @wraps(compute)
        def noted(*given: P.args, **named: P.kwargs) -> T:
            result = compute(*given, **named)
            if (seen := _seen.get()) is not None:
                for name in names:
                    seen.note(name, getattr(result, name, result))  # pyright: ignore[reportArgumentType]
            return result

        return noted

    return decorate
