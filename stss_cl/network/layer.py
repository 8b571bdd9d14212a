# SPDX-License-Identifier: MIT
"""A layer: a launch that goes over a list of tiles, and can be made to go over another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import pyopencl as cl

from stss_cl.device.discovery import Device
from stss_cl.device.launch import Launch, kernel
from stss_cl.device.program import build
from stss_cl.network.tiles import Maps, TileList, Tiling

FAST_MULTIPLY_ADD = "-cl-mad-enable"
"""The network's kernels may contract ``a * b + c``; fma() itself is a slow call on PoCL 3.0."""


class Source(NamedTuple):
    """What a kernel is built from: file, kernel, -D options, compiler flags."""

    file: str
    kernel: str
    options: Mapping[str, object]
    flags: str = ""


@dataclass(frozen=True)
class Layer(Launch):
    """A launch that computes the tiles of its output in a list; as it is made, all of them.

    Attributes:
        stage: the stage it belongs to, e.g. ``encoder``.
        source: of the kernel.
        tiling: of its output.
        reads: the change maps of what it reads; None: there are none.
        changes: that of its output; None: it has none.
    """

    stage: str
    source: Source
    tiling: Tiling
    reads: Maps | None
    changes: cl.Buffer | None

    def over(self, device: Device, tiles: TileList, *, marking: bool = False) -> Layer:
        """The same layer over other tiles.

        Args:
            device: it was made for.
            tiles: what to compute.
            marking: whether to mark, in ``changes``, the tiles where stored bits came to differ.
        """
        program = build(device, self.source.file, {**self.source.options, "MARK": marking}, self.source.flags)
        arguments = {**self.arguments, "tiles": tiles.tiles, "count": tiles.count}
        return replace(self, kernel=kernel(program, self.source.kernel, arguments), arguments=arguments)
