# SPDX-License-Identifier: MIT
"""Launches: a kernel with its arguments set, made once and enqueued for every frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl

from stss_cl.device.discovery import Device

Arguments = Mapping[str, Any]
"""A kernel's arguments by their names in its source, in order; bool and int stand for int32, float for float32, None for no buffer."""


@dataclass(frozen=True)
class Launch:
    """One kernel, ready to be enqueued.

    Attributes:
        name: the layer or step that it computes, e.g. ``down1.conv2``.
        kernel: the kernel with its arguments set.
        size: global size.
        group: work-group size; None = the runtime's choice.
        arguments: the arguments that it was made with, kept because OpenCL does not keep buffers alive.
    """

    name: str
    kernel: cl.Kernel
    size: tuple[int, ...]
    group: tuple[int, ...] | None
    arguments: Arguments

    def set(self, **values: Any) -> None:
        """Set arguments for later runs; the caller must keep buffers among them alive."""
        places = list(self.arguments)
        for name, value in values.items():
            self.kernel.set_arg(places.index(name), typed(value))

    def load(self, queue: cl.CommandQueue, **nothing: Any) -> None:
        """Launch it now with ``nothing`` to do, since runtimes load or compile a kernel at its first launch; its arguments stay."""
        self.set(**nothing)
        self.enqueue(queue)
        self.set(**{name: self.arguments[name] for name in nothing})

    def enqueue(self, queue: cl.CommandQueue) -> cl.Event:
        """Put it into the queue."""
        return cl.enqueue_nd_range_kernel(queue, self.kernel, self.size, self.group)


def kernel(program: cl.Program, name: str, arguments: Arguments) -> cl.Kernel:
    """A kernel of ``program`` with its arguments set."""
    made = cl.Kernel(program, name)
    made.set_args(*map(typed, arguments.values()))
    return made


def typed(value: Any) -> Any:
    """``value`` in the type that a kernel takes."""
    return np.int32(value) if isinstance(value, int) else np.float32(value) if isinstance(value, float) else value


def enqueue(device: Device, launches: Iterable[Launch]) -> None:
    """Put launches into the queue, and let the device begin."""
    for launch in launches:
        launch.enqueue(device.queue)
    device.queue.flush()
