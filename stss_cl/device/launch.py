# SPDX-License-Identifier: MIT
"""Launches: a kernel with its arguments set by name, made once and enqueued for every frame."""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator, Hashable, Iterable, Mapping, Set
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl

from stss_cl.device.discovery import Device
from stss_cl.device.program import Program

Arguments = Mapping[str, Any]
"""A kernel's arguments by their names in its source, and those of structs by the names of their members; None: no buffer."""

NUMBERS: Mapping[str, type] = {"int": np.int32, "uint": np.uint32, "float": np.float32, "ulong": np.uint64}
"""Type of a number in a kernel -> NumPy's; a number is of Python or NumPy, and a bool is an int."""
NO_BUFFER = np.uintp(0)
"""In place of a buffer; PyOpenCL before 2026.1.4 refuses None."""
FORMATS = {"int": "i", "uint": "I", "float": "f"}
"""Type of a struct's member -> its format for Python's ``struct``: all have the same size, so there is no padding between them."""


class Load(NamedTuple):
    """The first launch of a kernel, for which the runtime compiles it.

    ``key``: program, kernel and work-group, for which it is compiled once.
    """

    key: Hashable
    run: Callable[[], None]


_waiting: ContextVar[list[Load] | None] = ContextVar("_waiting", default=None)


@contextmanager
def defer_loads() -> Generator[list[Load]]:
    """Within the block, and in this thread, ``load`` launches nothing: the list gets the launches, for the caller to run."""
    loads: list[Load] = []
    token = _waiting.set(loads)
    try:
        yield loads
    finally:
        _waiting.reset(token)


class Kernel:
    """A kernel whose arguments are set by name.

    Args:
        program: the program with the kernel.
        name: the kernel's name.
        arguments: the arguments that are known by now.

    Raises:
        TypeError: the kernel has no such argument, or it is of another type.
    """

    def __init__(self, program: Program, name: str, arguments: Arguments | None = None):
        self.name = name
        self._program = program
        self._handle: cl.Kernel | None = None
        self._values: dict[int, Any] = {}
        self._places: dict[str, tuple[int, str]] = {}
        self._members: dict[str, tuple[int, str]] = {}
        self._structs: dict[int, tuple[str, dict[str, float]]] = {}
        for place, (argument, kind) in enumerate(program.arguments(name)):
            members = program.structs.get(kind)
            if members is None:
                self._places[argument] = place, kind
            else:
                self._members |= {member: (place, of) for member, of in members.items()}
                self._structs[place] = "".join(FORMATS[of] for of in members.values()), dict.fromkeys(members, 0)
        self._open: Set[str] = self._places.keys() | self._members.keys()
        self.set(**(arguments or {}))

    def set(self, **values: Any) -> None:
        """Set arguments; the caller keeps buffers among them alive, which OpenCL does not.

        Raises:
            TypeError: the kernel has no such argument, or it is of another type.
        """
        structs: set[int] = set()
        for name, value in values.items():
            if name in self._places:
                place, kind = self._places[name]
                self._set(place, self._convert(name, value, kind))
            elif name in self._members:
                place, kind = self._members[name]
                self._structs[place][1][name] = self._convert(name, value, kind)
                structs.add(place)
            else:
                raise TypeError(f"kernel {self.name}: it has no argument {name}")
        for place in structs:
            layout, members = self._structs[place]
            self._set(place, struct.pack(layout, *members.values()))
        if self._open:
            self._open = self._open - values.keys()

    def enqueue(self, queue: cl.CommandQueue, size: tuple[int, ...], group: tuple[int, ...] | None) -> cl.Event:
        """Enqueue the kernel over a global size in work-groups.

        Raises:
            TypeError: an argument has not been set, or the source has an unknown form.
            DeviceError: its program does not build.
        """
        handle = self._handle or self._make()
        if self._open:
            raise TypeError(f"kernel {self.name}: argument {min(self._open)} is missing")
        return cl.enqueue_nd_range_kernel(queue, handle, size, group)

    def load(
        self, queue: cl.CommandQueue, size: tuple[int, ...], group: tuple[int, ...] | None, nothing: Arguments, own: Arguments
    ) -> None:
        """Launch it with the arguments ``nothing`` for no work, then set ``own``: runtimes compile a kernel at its first launch.

        Within `defer_loads` this waits.
        """
        load = Load((id(self._program), self.name, group), partial(self._load, queue, size, group, nothing, own))
        waiting = _waiting.get()
        if waiting is None:
            load.run()
        else:
            waiting.append(load)

    def _load(
        self, queue: cl.CommandQueue, size: tuple[int, ...], group: tuple[int, ...] | None, nothing: Arguments, own: Arguments
    ) -> None:
        missing = self._open
        unset = {name: None if name in self._places and self._places[name][1].endswith("*") else 0 for name in missing}
        self.set(**{**unset, **nothing})
        self.enqueue(queue, size, group)
        self.set(**own)
        self._open = missing

    def _set(self, place: int, value: Any) -> None:
        if self._handle is None:
            self._values[place] = value
        else:
            self._handle.set_arg(place, value)

    def _make(self) -> cl.Kernel:
        """OpenCL's kernel, at the first launch: until then its program need not be built."""
        handle, count = cl.Kernel(self._program.handle, self.name), len(self._program.arguments(self.name))
        if count != handle.num_args:
            raise TypeError(f"kernel {self.name}: it takes {handle.num_args} arguments, read {count} in its source")
        for place, value in self._values.items():
            handle.set_arg(place, value)
        self._handle = handle
        self._values.clear()
        return handle

    def _convert(self, name: str, value: Any, kind: str) -> Any:
        """``value`` in the type that the kernel takes."""
        if kind.endswith("*"):
            fits = value is None or isinstance(value, cl.MemoryObjectHolder | cl.LocalMemory)
        else:
            numbers = (float, np.floating, int, np.integer) if kind == "float" else (int, np.integer, np.bool_)
            fits = kind in NUMBERS and isinstance(value, numbers)
        if not fits:
            raise TypeError(f"kernel {self.name}: argument {name} is {kind}, got {type(value).__name__}")
        if kind.endswith("*"):
            return NO_BUFFER if value is None else value
        return NUMBERS[kind](value)


@dataclass(frozen=True)
class Launch:
    """One kernel, ready to be enqueued once its arguments are set.

    Attributes:
        name: the layer or step that it computes, e.g. ``down1.conv2``.
        kernel: the kernel.
        arguments: its first arguments, kept because OpenCL does not keep buffers alive.
        size: global size.
        group: work-group size; None = the runtime's choice.
    """

    name: str
    kernel: Kernel
    arguments: Arguments
    size: tuple[int, ...]
    group: tuple[int, ...] | None

    def set(self, **values: Any) -> None:
        """Set arguments for later runs; the caller must keep buffers among them alive."""
        self.kernel.set(**values)

    def load(self, queue: cl.CommandQueue, **nothing: Any) -> None:
        """Launch it now with the arguments ``nothing``, so that it does no work; its own arguments stay."""
        own = {name: self.arguments[name] for name in nothing if name in self.arguments}
        self.kernel.load(queue, self.size, self.group, nothing, own)

    def enqueue(self, queue: cl.CommandQueue) -> cl.Event:
        """Put it into the queue."""
        return self.kernel.enqueue(queue, self.size, self.group)


def enqueue(device: Device, launches: Iterable[Launch]) -> None:
    """Put launches into the queue, and let the device begin."""
    for launch in launches:
        launch.enqueue(device.queue)
    device.queue.flush()
