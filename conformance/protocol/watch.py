# SPDX-License-Identifier: MIT
"""Watch a copy of the reference from outside: the network's inputs and its layers, as they are computed."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, Protocol

from conformance.protocol.port import AnyArray

LAYER_FUNCTIONS = ("conv_named", "gated")
"""Functions of input, weights and a layer's name: their result is that layer."""
ACTIVATION = "relu"
"""The function whose result takes the place of the layer that it is applied to."""
RESULTS = {"erm": ("reshaded",), "prepare": ("color", "mask", "history")}
"""Functions whose result is an array of this name, or has attributes of these names."""

Function = Callable[..., Any]


class Functions(Protocol):
    """A copy of the reference, see `conformance.protocol.reference_copy.Copy`."""

    def wrap_all(self, attribute: str, around: Callable[[Function], Function]) -> None:
        """Put ``around(function)`` in the place of the function ``attribute`` of every module that has one."""
        ...


@dataclass
class Activations:
    """Arrays of one computation.

    Attributes:
        arrays: by name, in the order of computation; of a layer that ran for each of the three earlier frames, three.
        last: the latest name.
    """

    arrays: dict[str, list[AnyArray]] = field(default_factory=dict[str, list[AnyArray]])
    last: str = ""

    def note(self, name: str, array: AnyArray) -> None:
        """Add an array."""
        self.arrays.setdefault(name, []).append(array)
        self.last = name

    def note_activation(self, x: AnyArray, y: AnyArray) -> None:
        """Put ``y`` in the place of the latest array, if that is ``x``."""
        if self.last and self.arrays[self.last][-1] is x:
            self.arrays[self.last][-1] = y


class Watch:
    """Watches one copy, whose functions it wraps."""

    def __init__(self, functions: Functions) -> None:
        self._record: ContextVar[Activations | None] = ContextVar("seen", default=None)
        for name in LAYER_FUNCTIONS:
            functions.wrap_all(name, self._around(lambda record, arguments, y: record.note(arguments[2], y)))
        functions.wrap_all(ACTIVATION, self._around(lambda record, arguments, y: record.note_activation(arguments[0], y)))
        for name, results in RESULTS.items():
            functions.wrap_all(name, self._around(lambda record, _, y, results=results: _note_all(record, results, y)))

    @contextmanager
    def open(self) -> Generator[Activations]:
        """Record while this is open; otherwise nothing is kept."""
        record = Activations()
        token = self._record.set(record)
        try:
            yield record
        finally:
            self._record.reset(token)

    def _around(self, note: Callable[[Activations, tuple[Any, ...], Any], None]) -> Callable[[Function], Function]:
        def around(compute: Function) -> Function:
            @wraps(compute)
            def noted(*arguments: Any, **keywords: Any) -> Any:
                result = compute(*arguments, **keywords)
                if (record := self._record.get()) is not None:
                    note(record, arguments, result)
                return result

            return noted

        return around


def _note_all(record: Activations, names: tuple[str, ...], result: Any) -> None:
    for name in names:
        record.note(name, getattr(result, name, result))
