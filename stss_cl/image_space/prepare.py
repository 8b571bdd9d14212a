# SPDX-License-Identifier: MIT
"""The stages of a frame before the network, fused: motion chain, warp, holes, occlusion warp, packing."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import Inputs, inputs_for
from stss_cl.device.discovery import Device
from stss_cl.device.program import build
from stss_cl.image_space.frame_planes import MOST_STEPS, Source, Sources, check_steps, planes, upload
from stss_cl.image_space.stages import LIMITS, Gather, kernels, launch
from stss_ref.weights import SecondColor

FINITE = ("colors", "gbuffer", "nov", "stencils", "normals")
"""The arrays that must be finite: a ReLU could turn a NaN into 0 unnoticed."""


def _filled_up(buffers: tuple[cl.Buffer, ...], count: int) -> tuple[cl.Buffer, ...]:
    """As many arguments as a kernel has: the last buffer stands for planes that this frame does not read."""
    return (*buffers, *count * buffers[-1:])[:count]


class Prepare:
    """The kernels and buffers of one size of frame; the same values as ``stss_ref.frame.prepare`` in float32.

    Args:
        device: to run on.
        height, width: of the frames.
        gather: how the motion chain reads between pixels.
        eights: whether a work-item computes eight pixels in a row; None: on CPUs.
        inputs: buffers to write to; None: buffers of its own. If they have change maps, only ``dirty`` tiles are computed.
        second: the network's second colour, see ``stss_ref.frame.prepare``.

    Attributes:
        inputs: the network's inputs on the device; every frame writes to the same buffers.
        mask: (H, W) uint8, 1 = not a hole of the newest colour frame.
        dirty: a byte for each 4 x 4 pixels of ``inputs.input``: 0: the inputs there are those of the last frame, and no hole is filled.
    """

    def __init__(
        self,
        device: Device,
        height: int,
        width: int,
        gather: Gather = "longest",
        *,
        eights: bool | None = None,
        inputs: Inputs | None = None,
        second: SecondColor = "newest",
    ) -> None:
        self.device, self.height, self.width = device, height, width
        self.rows, self.columns = -(-height // 8) * 8, -(-width // 8) * 8
        eights = device.is_cpu if eights is None else eights
        self.inputs = inputs_for(device, self.rows, self.columns, np.dtype(np.float32)) if inputs is None else inputs
        self.rows = self.inputs.input.height  # of a strip, where the frame goes in strips
        self._changes = self.inputs.changes
        self._maps: tuple[cl.Buffer, ...] = () if self._changes is None else self._changes.buffers
        self._file, self._gather, self._earlier = "frame8.cl" if eights else "frame.cl", gather, second == "earlier"
        self._kernels = self._built(looking=bool(self._maps))
        self.mask = self._filled(height * width)
        self.dirty = self._filled(self.rows // 4 * (self.columns // 4), 1)
        self._chained = self._filled(3 * height * width * 2 * 4)
        self._bad = self._filled(4 * len(FINITE))
        # Places that holes look up are wanted: ``prepare`` makes them so, and ``fill_holes`` unmakes them.
        self._keys, self._first = self._filled(height * width * 4), self._filled(height * width * 4)
        self._read: Sources | None = None
        self._done: cl.Event | None = None

    def _built(self, *, looking: bool) -> dict[str, cl.Kernel]:
        """The kernels by name; ``looking``: the kernels that compute only dirty tiles, and mark tiles that then differ."""
        options: dict[str, object] = {"HALF": self.inputs.input.dtype == np.float16, "MARK": looking}
        own = {"GATHER": f"gather_{self._gather}", "STREAM": self.device.streams, "EARLIER": self._earlier}
        made = kernels(self.device, self._file, {**own, **options, **LIMITS})
        if self._gather != "longest":
            made.pop("chain_steps8", None)  # its gather is that one
        eighth = build(self.device, "downsample_8.cl", {"MASK": "uchar", **options})
        return made | {"downsample_8": cl.Kernel(eighth, "downsample_8")}

    @cached_property
    def _unlooking(self) -> dict[str, cl.Kernel]:
        """Built at its first use."""
        return self._built(looking=False)

    def begin(
        self,
        colors: Source,
        steps: Sequence[int],
        motions: Source,
        gbuffer: Source,
        nov: Source,
        stencils: Source,
        normals: Source,
        positions: Source,
        tops: Sequence[int] = (0,),
        *,
        frames: int = 3,
    ) -> None:
        """Enqueue the frame's image-space stages up to the splat; the arguments are those of ``stss_ref.frame.FrameInputs``.

        ``strip`` then finishes each of the strips that begin at ``tops``. ``frames``: see ``start``.

        On a CPU arrays are read in place: they must not change until the queue has finished this frame. All but motions and
        positions must be finite: ``not_finite`` checks those that are read afterwards.

        Raises:
            ArrayError: shapes, dtypes or steps are not a frame's.
        """
        chosen, size, device = check_steps(steps), (self.height, self.width), self.device
        if self._done is not None:
            self._done.wait()  # until then the last frame's arrays are in use
        read, far = frames, chosen[frames - 1]
        sources = Sources(
            steps=chosen,
            colors=planes(device, "colors", colors, read, (*size, 3), stack=3),
            motions=planes(device, "motions", motions, far, (*size, 2), stack=None) if far else (),
            gbuffer=upload(device, "gbuffer", gbuffer, (*size, 9)),
            nov=upload(device, "nov", nov, size),
            stencils=planes(device, "stencils", stencils, read + 1, size, stack=4),
            normals=planes(device, "normals", normals, read + 1, (*size, 3), stack=4),
            positions=planes(device, "positions", positions, read + 1, (*size, 3), stack=4),
        )
        self.start(sources, tops, frames=frames, checks=True)

    def start(
        self,
        sources: Sources,
        tops: Sequence[int] = (0,),
        *,
        frames: int = 3,
        looking: bool = True,
        checks: bool = False,
    ) -> None:
        """``begin`` for what is on the device already, and known to be finite.

        Args:
            sources: the planes to read; kept until the next frame.
            tops: see ``begin``.
            frames: how many of the three colour frames are read, from the newest on; 2 only for an earlier second colour. With less
                than 3 not all of ``inputs.earlier`` is written.
            looking: use change maps; False: everything is computed, and nothing is marked.
            checks: have ``not_finite`` tell what is not finite after all; normals are then three floats apart.
        """
        self._read, self._tops, self._frames = sources, tuple(tops), frames
        self._looks = looking and bool(self._maps)
        newest, middle, oldest = (*sources.steps[:frames], 0, 0)[:3]
        size, skip = (self.height, self.width), self._clear()
        # A chain of one motion is that motion. With change maps it is written all the same: a later frame may read it.
        self._motion = sources.motions[0] if newest == frames == 1 and not self._maps else self._chained
        if self._motion is self._chained and any((newest, middle, oldest)):
            motions = _filled_up(sources.motions, MOST_STEPS)
            self._run("chain_steps", size, *motions, newest, middle, oldest, self._chained, *size, *skip)
        for top in self._tops:
            self._warp(top, checks=checks, marks=True)
        if newest > 0:
            self._run("splat_nearest", size, self._motion, sources.gbuffer, 9, 3, self._keys, *size)
            self._run("splat_first", size, self._motion, sources.gbuffer, 9, 3, self._keys, self._first, *size)

    def not_finite(self) -> str | None:
        """Name of an array of the frame begun last that must be finite and is not; None: all are. Waits for the queue."""
        bad = np.empty(len(FINITE), np.int32)
        cl.enqueue_copy(self.device.queue, bad, self._bad)
        if not bad.any():
            return None
        cl.enqueue_fill_buffer(self.device.queue, self._bad, np.zeros(1, np.int32), 0, bad.nbytes)
        return FINITE[int(bad.argmax())]

    def strip(self, top: int = 0) -> None:
        """Enqueue the rest of the work for the rows of ``inputs`` that begin at row ``top`` of the frame, one of ``begin``'s."""
        assert self._read is not None
        if len(self._tops) > 1:
            self._warp(top, checks=False, marks=False)  # an earlier strip's values have been overwritten
        size, inputs = (self.height, self.width), self.inputs
        if self._read.steps[0]:
            place = (*size, self.rows, self.columns, top)
            changes = (self._maps[0],) if self._looks else ()
            written = inputs.input.data, inputs.base
            self._run(
                "fill_holes",
                place[2:4],
                self._read.colors[0],
                self._motion,
                self._keys,
                self._first,
                self.mask,
                *written,
                *place,
                *changes,
            )
        eighth = inputs.eighth
        shape = eighth.height, eighth.width
        place = (*size, *shape, eighth.columns, top)
        changes = self._maps[2:] if self._looks else (eighth.data,)
        read = self._read.gbuffer, self.mask
        self._done = self._run("downsample_8", shape, *read, eighth.data, *place, *changes)

    @property
    def _now(self) -> dict[str, cl.Kernel]:
        return self._kernels if self._looks or not self._maps else self._unlooking

    def _clear(self) -> tuple[cl.Buffer, ...]:
        """Unmark all inputs; the map that tells a kernel where to compute."""
        if not self._looks or self._changes is None:
            return ()
        self._changes.clear()
        return (self.dirty,)

    def _warp(self, top: int, *, checks: bool, marks: bool) -> None:
        """Warp the colour frames and find their holes; for the newest, mark the places that holes look up.

        ``checks``: look for what is not finite; ``marks``: False if the places were marked before.
        """
        s, inputs = self._read, self.inputs
        assert s is not None
        place = (self.height, self.width, self.rows, self.columns, top)
        stencils, normals, positions = (_filled_up(of, 4) for of in (s.stencils, s.normals, s.positions))
        colors = *_filled_up(s.colors, 3), *s.steps
        read = *colors, self._motion, s.gbuffer, s.nov, *stencils, *normals, *positions, s.normal_stride
        written = self._keys, self._first, inputs.earlier.data, inputs.input.data, inputs.base, self.mask, self._bad
        skip = (self.dirty, *self._maps[:2]) if self._looks else ()
        for chosen in (range(1, self._frames), range(1)) if self._earlier else (range(self._frames),):
            stores = self._frames == 3 or chosen.start == 1
            self._run("prepare", place[2:4], *read, *written, checks, stores, marks, *place, *skip, planes=chosen)

    def _run(
        self, name: str, size: tuple[int, int], *arguments: cl.Buffer | int | np.float32, planes: range | None = None
    ) -> cl.Event:
        """Enqueue a kernel over ``size`` (rows, columns), eight pixels to a work-item if there is one that does so."""
        kernel, (rows, columns) = self._now[name], size
        if eight := self._now.get(f"{name}8"):
            kernel, columns = eight, -(-columns // 8)
        return launch(self.device, kernel, columns, rows, *arguments, planes=planes)

    def _filled(self, size: int, value: int = 0) -> cl.Buffer:
        buffer = cl.Buffer(self.device.context, cl.mem_flags.READ_WRITE, size)
        cl.enqueue_fill_buffer(self.device.queue, buffer, np.full(1, value, np.uint8), 0, size)
        return buffer
