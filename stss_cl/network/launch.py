# SPDX-License-Identifier: MIT
"""Launches: a kernel with its arguments set, made once and enqueued for every frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import pyopencl as cl

from stss_cl.device.discovery import Device
from stss_cl.device.program import build

FAST_MULTIPLY_ADD = "-cl-mad-enable"
"""The network's kernels may contract ``a * b + c``; fma() itself is a slow call on PoCL 3.0."""

Arguments = Mapping[str, Any]
"""A kernel's arguments by their names in its source, in order."""


@dataclass(frozen=True)
class Skip:
    """What it takes to make a launch that computes only what changed or is wanted from one that computes everything.

    Source: kernels/change_map.clh, kernels/flat_tiles.cl.

    Attributes:
        file: of the kernel.
        options: it is built with, SKIP or WANTED besides.
        flags: further ones.
        size: global size.
        group: work-group size; None = the runtime's choice.
        maps: the change maps, behind the launch's own arguments.
        numbers: behind them.
        bounded: whether a tolerance follows.
    """

    file: str
    options: Mapping[str, object]
    flags: str
    size: tuple[int, ...]
    group: tuple[int, ...] | None
    maps: Arguments
    numbers: Arguments = field(default_factory=dict[str, Any])
    bounded: bool = True


@dataclass(frozen=True)
class Launch:
    """One kernel, ready to go.

    Attributes:
        stage: the stage it belongs to, e.g. ``encoder``.
        name: what it computes, e.g. ``down1.conv2``.
        kernel: with its arguments set.
        size: global size.
        group: work-group size; None = the runtime's choice.
        arguments: those that it was made with: OpenCL does not keep buffers alive.
        skip: where inputs and outputs have change maps.
    """

    stage: str
    name: str
    kernel: cl.Kernel
    size: tuple[int, ...]
    group: tuple[int, ...] | None
    arguments: Arguments
    skip: Skip | None = None

    def set(self, **values: Any) -> None:
        """Set arguments from now on; buffers among them are the caller's to keep."""
        places = list(self.arguments)
        for name, value in values.items():
            self.kernel.set_arg(places.index(name), value)

    def enqueue(self, queue: cl.CommandQueue) -> None:
        """Put it into the queue."""
        cl.enqueue_nd_range_kernel(queue, self.kernel, self.size, self.group)

    def skipping(self, device: Device, option: Mapping[str, object], arguments: Arguments) -> Launch:
        """The launch that leaves something out: built with one ``option`` more, ``arguments`` behind its own."""
        skip = self.skip
        assert skip is not None
        kernel = cl.Kernel(build(device, skip.file, {**skip.options, **option}, skip.flags), self.kernel.function_name)
        together = {**self.arguments, **arguments}
        kernel.set_args(*together.values())
        return replace(self, kernel=kernel, size=skip.size, group=skip.group, arguments=together)
