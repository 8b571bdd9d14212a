# SPDX-License-Identifier: MIT
"""A layer: a launch over a list of tiles, which can be replaced."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.buffers import FeatureMap
from stss_cl.device.discovery import Device
from stss_cl.device.launch import Arguments, Kernel, Launch
from stss_cl.device.program import marking, program_for
from stss_cl.network.tiles import Maps, TileList, Tiling, whole

FAST = "-cl-mad-enable"
"""Kernels of the network may contract ``a * b + c``; fma() itself is a slow call on PoCL 3.0."""


class KernelSource(NamedTuple):
    """The source of a kernel: file, name, -D options, compiler flags."""

    file: str
    kernel: str
    options: Mapping[str, object]
    flags: str = ""


class Work(NamedTuple):
    """The work of a launch: the tiles of its output, global size and work-group."""

    tiling: Tiling
    size: tuple[int, ...]
    group: tuple[int, ...]


@dataclass(frozen=True)
class Shape:
    """The differences between convolution kernels; their arguments are the same.

    Attributes:
        file: the kernel's file; the kernel has the same name.
        options: build options, besides those of the layer.
        weight, gate: the tensors as the kernel reads them; gate None: there is none, or it is part of ``weight``.
        tiling: the tiles of the output.
        bias: in place of the layer's own bias; None: the layer's own.
        size, group: global size and work-group of the launch.
    """

    file: str
    options: Mapping[str, object]
    weight: NDArray[Any]
    gate: NDArray[Any] | None
    tiling: Tiling
    size: tuple[int, ...]
    group: tuple[int, ...]
    bias: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class LayerLaunch(Launch):
    """A launch that computes the tiles of its output in a list; at first the list has all tiles.

    Attributes:
        stage: the stage that it belongs to, e.g. ``encoder``.
        source: the kernel's source.
        tiling: the tiles of its output.
        reads: the change maps of its inputs; None: there are none.
        changes: the change map of its output; None: there is none.
    """

    stage: str
    source: KernelSource
    tiling: Tiling
    reads: Maps | None
    changes: cl.Buffer | None

    def over(self, device: Device, tiles: TileList) -> LayerLaunch:
        """The same layer over other tiles, which marks, in ``changes``, those whose stored bits change.

        Args:
            device: the device that it was made for.
            tiles: the tiles to compute.
        """
        marks = {} if self.changes is None else {"changes": self.changes}
        arguments = {**self.arguments, "tiles": tiles.tiles, "count": tiles.count, **marks}
        return replace(self, kernel=_kernel(device, self.source, arguments), arguments=arguments)


def layer(
    device: Device,
    stage: str,
    name: str,
    source: KernelSource,
    arguments: Arguments,
    work: Work,
    reads: Maps | None,
    out: FeatureMap | None,
) -> LayerLaunch:
    """A layer over all tiles of its output.

    Args:
        device: to run on.
        stage, name, source, reads: see ``LayerLaunch``.
        arguments: those of the kernel, without the list and, if it can mark, the output's map.
        work: its tiles and sizes.
        out: the activations that it writes and marks; None: it writes the image.
    """
    tiling, size, group = work
    tiles = whole(device, tiling.lines, tiling.columns)
    marks = {} if out is None else {"changes": None}
    together = {**arguments, "tiles": tiles.tiles, "count": tiles.count, **marks}
    kernel = _kernel(device, source, together)
    return LayerLaunch(name, kernel, together, size, group, stage, source, tiling, reads, None if out is None else out.changes)


def _kernel(device: Device, source: KernelSource, arguments: Arguments) -> Kernel:
    """The kernel with its arguments set; it marks changes if it is given a change map."""
    marks = marking(device, arguments["changes"] is not None) if "changes" in arguments else {}
    return Kernel(program_for(device, source.file, {**source.options, **marks}, source.flags), source.kernel, arguments)
