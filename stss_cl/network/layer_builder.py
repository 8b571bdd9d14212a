# SPDX-License-Identifier: MIT
"""Launches one behind the other, with the buffers between them: what ``stss_cl.network.layers`` builds the network of."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.buffers import Padded, padded
from stss_cl.device.discovery import Device
from stss_cl.device.grid import grid
from stss_cl.device.program import build
from stss_cl.network.launch import FAST_MULTIPLY_ADD, IMAGE_ARGUMENT, Final, Launch, Skip, conv, half
from stss_cl.network.pack_weights import pack
from stss_cl.skip.changed_tiles import ChangedOnly, Maps
from stss_cl.skip.error_control import WHOLE, Level, levels
from stss_cl.skip.flat_tiles import Plain
from stss_ref.weights import Weights, reads_history


class Chain:
    """Launches in order, of which the last one writes an image.

    Args:
        device: to run on.
        weights: the 92 tensors.
        precision: see ``stss_cl.network.network.PRECISIONS``.
        height, width: of the largest activations, multiples of 8.
        keep: every layer keeps what it wrote, with a change map, so that ``run_changed`` can be had; and what these weights do not
            read of the inputs is computed once, by ``begin``.
    """

    def __init__(self, device: Device, weights: Weights, precision: str, height: int, width: int, keep: bool):
        self.launches: list[Launch] = []
        self.keep, self.reads_history = keep, not keep or reads_history(weights)
        self._device, self._weights = device, weights
        self._winograd = precision != "float32-direct"
        self._dtype = dtype_of(precision)
        self._height, self._width = height, width
        self._maps = Maps(device, height, width)
        self._shared: dict[tuple[str, int, int], Padded] = {}
        self._changed: ChangedOnly | None = None
        self._marked: list[Padded] = []

    def ready(self, image: cl.Buffer) -> list[Launch]:
        """The launches in order, the last of them to write ``image`` (2H, 2W, 3) float32."""
        last = self.launches[-1]
        last.kernel.set_arg(IMAGE_ARGUMENT[last.kernel.function_name], image)
        return self.launches

    def begin(self) -> None:
        """Enqueue, before the first ``run``, what no later one computes again."""
        self._enqueue(launch for i, launch in enumerate(self.launches) if i in self.levels[0].stays)

    def run(self, image: cl.Buffer, level: Level = WHOLE, plain: Plain | None = None) -> None:
        """Enqueue the network but for what is left out at ``level``; ``image`` is complete when the queue has run dry.

        ``plain`` is what leaves plain tiles out.
        """
        assert plain is not None or not level.plain
        launches = plain.ready(image) if plain is not None and level.plain else self.ready(image)
        self._enqueue(launch for i, launch in enumerate(launches) if i not in level.stays)

    def complete(self, image: cl.Buffer, level: Level) -> None:
        """After ``run`` at ``level``: enqueue what was left out, and what is made of it. The same bits as ``run`` of the whole."""
        stayed, reads_it = level.stays - self.levels[0].stays, "" if level == self.levels[0] else "decoder"
        self._enqueue(launch for i, launch in enumerate(self.ready(image)) if i in stayed or launch.stage == reads_it)

    @cached_property
    def levels(self) -> tuple[Level, ...]:
        """See ``stss_cl.skip.error_control.levels``; only nothing may be left out where layers share buffers."""
        return levels(self.launches, self.reads_history) if self.keep else (WHOLE,)

    def _enqueue(self, launches: Iterable[Launch]) -> None:
        for launch in launches:
            launch.enqueue(self._device.queue)
        self._device.queue.flush()

    def run_changed(self, image: cl.Buffer, tolerance: float = 0.0) -> None:
        """Enqueue what the marks in the change maps of ``inputs`` lead to; the rest of ``image``, the last one made, stays.

        Whoever fills the network's inputs marks the tiles that came to differ since the last run of either kind, and clears the
        marks behind this one.

        Args:
            image: as for ``run``.
            tolerance: a stored value between two layers that is no further than this from the new one stays; 0: the image has
                the bits of ``run``'s, if all runs since the last of those had 0.
        """
        self.changed_only().run(image, tolerance)

    def changed_only(self) -> ChangedOnly:
        """The launches of ``run_changed``, built when they are first asked for."""
        if self._changed is None:
            run = [launch for i, launch in enumerate(self.launches) if i not in self.levels[0].stays]
            self._changed = ChangedOnly(self._device, run, self._maps)
        return self._changed

    def activity(self) -> NDArray[np.float32]:
        """Where the last ``run_changed`` changed anything: the share of the stored activations, for each 4 x 4 pixels of the largest.

        Waits for the queue. A tile of smaller activations counts for all the pixels that it stands for.
        """
        size = self._height // 4, self._width // 4
        total, values = np.zeros(size, np.float32), 0.0
        for buffer in self._marked:
            assert buffer.changes is not None
            marks = np.empty((-(-buffer.height // 4), -(-buffer.width // 4)), np.uint8)
            cl.enqueue_copy(self._device.queue, marks, buffer.changes)
            divisor = self._height // buffer.height
            share = buffer.channels / divisor**2
            total += share * marks.repeat(divisor, 0).repeat(divisor, 1)[: size[0], : size[1]]
            values += share
        return (total / values).astype(np.float32)

    def _padded(self, divisor: int, channels: int) -> Padded:
        height, width = self._height // divisor, self._width // divisor
        made = padded(self._device, height, width, channels, self._dtype)
        if not self.keep:
            return made
        self._marked.append(replace(made, changes=self._maps.take(height, width)))
        return self._marked[-1]

    def _scratch(self, name: str, divisor: int, channels: int) -> Padded:
        """Activations that are soon done with: those that this name and size had before, but that each is kept if all are."""
        key = name, divisor, channels
        if self.keep or key not in self._shared:
            self._shared[key] = self._padded(divisor, channels)
        return self._shared[key]

    def _conv(
        self,
        stage: str,
        name: str,
        a: Padded,
        out: Padded,
        *,
        b: Padded | None = None,
        channels: tuple[int, ...] | None = None,
        stride: int = 1,
        relu: bool = True,
        out_first: int = 0,
        image: int = 0,
        final: Final | None = None,
    ) -> Padded:
        """Append a convolution; ``channels``: how many of each input's are real, where not all."""
        held = (a,) if b is None else (a, b)
        # At an eighth a tile of 4 x 4 would be 32 pixels of the frame, and rounding spreads by a tile a layer: decision 21.
        side = 0 if not self._winograd else 2 if out.height * 8 == self._height else 4
        real = channels or tuple(x.channels for x in held)
        packed = pack(self._weights, name, tuple((n, x.channels) for n, x in zip(real, held, strict=True)))
        launch = conv(
            self._device, stage, name, packed, a, b, out,
            out_first=out_first, stride=stride, relu=relu, side=side, image=image, final=final,
        )  # fmt: skip
        self.launches.append(launch)
        return out

    def _kernel(
        self,
        stage: str,
        name: str,
        file: str,
        options: dict[str, object],
        size: tuple[int, int],
        *arguments: Any,
        group: tuple[int, int] | None = None,
        maps: tuple[cl.Buffer | None, ...] = (),
        changed_size: tuple[int, int] | None = None,
        bounded: bool = True,
    ) -> None:
        """Append any other kernel; whole numbers among the arguments are int32. ``maps``, ``changed_size``: for -D SKIP."""
        # Interpolation is not contracted: it then has the reference's bits.
        flags = FAST_MULTIPLY_ADD if file == "erm.cl" else ""
        options = {**options, "HALF": half(self._dtype)}
        kernel = cl.Kernel(build(self._device, file, options, flags), name)
        held = tuple(np.int32(a) if isinstance(a, int) else a for a in arguments)
        kernel.set_args(*held)
        if group is None:
            size, group = grid(self._device, *size)
        # Of changes work-items are few and do much: PoCL would take them all for one work-group.
        changed_group = group if changed_size is None else (1, 1) if self._device.is_cpu else None
        skip = Skip(file, options, flags, changed_size or size, changed_group, maps, (), bounded) if self.keep else None
        self.launches.append(Launch(stage, name, kernel, size, group, held, skip))


def dtype_of(precision: str) -> np.dtype[Any]:
    """What activations are stored as."""
    return np.dtype(np.float16 if precision == "half" else np.float32)
