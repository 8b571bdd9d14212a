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

FINITE = ("colors", "gbuffer", "nov", "stencils", "normals")
"""The arrays that must be finite: a ReLU could turn a NaN into 0 unnoticed."""
SCANNERS = 64, 1 << 15
"""Work-items that search for values that are not finite, on a processor and on a GPU."""
NOBODY, UNWANTED = 0xFFFFFFFF, 0
"""Content of the splat's two buffers where no motion is needed (kernels/occlusion_warp.cl)."""


def finite_kernel(device: Device) -> cl.Kernel:
    """What ``scan`` launches."""
    return cl.Kernel(build(device, "finite.cl", {"APART": not device.is_cpu}), "finite")


def scan(device: Device, finite: cl.Kernel, buffer: cl.Buffer, count: int, bad: cl.Buffer, which: int) -> None:
    """Enqueue a look at ``count`` values: ``bad[which]`` (int32) becomes 1 if one of them is not finite."""
    finite(device.queue, (SCANNERS[not device.is_cpu],), None, buffer, np.uint64(count), bad, np.int32(which))


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
    ) -> None:
        self.device, self.height, self.width = device, height, width
        self.rows, self.columns = -(-height // 8) * 8, -(-width // 8) * 8
        eights = device.is_cpu if eights is None else eights
        self.inputs = inputs_for(device, self.rows, self.columns, np.dtype(np.float32)) if inputs is None else inputs
        self.rows = self.inputs.input.height  # of a strip, where the frame goes in strips
        self._changes = self.inputs.changes
        self._maps: tuple[cl.Buffer, ...] = () if self._changes is None else self._changes.buffers
        self._file, self._gather = "frame8.cl" if eights else "frame.cl", gather
        self._kernels = self._built(looking=bool(self._maps))
        self.mask = self._filled(height * width)
        self.dirty = self._filled(self.rows // 4 * (self.columns // 4), 1)
        self._chained = self._filled(3 * height * width * 2 * 4)
        self._finite, self._bad = finite_kernel(device), self._filled(4 * len(FINITE))
        self._splat = self._filled(height * width * 4), self._filled(height * width * 4)
        self._read: Sources | None = None
        self._done: cl.Event | None = None

    def _built(self, *, looking: bool) -> dict[str, cl.Kernel]:
        """The kernels by name; ``looking``: the kernels that compute only dirty tiles, and mark tiles that then differ."""
        options: dict[str, object] = {"HALF": self.inputs.input.dtype == np.float16, "MARK": looking}
        own = {"GATHER": f"gather_{self._gather}", "STREAM": self.device.streams}
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
        older: bool = True,
    ) -> None:
        """Enqueue the frame's image-space stages up to the splat; the arguments are those of ``stss_ref.frame.FrameInputs``.

        ``strip`` then finishes each of the strips that begin at ``tops``. ``older``: see ``start``.

        On a CPU arrays are read in place: they must not change until the queue has finished this frame. All but motions and
        positions must be finite: ``not_finite`` checks those that are read afterwards.

        Raises:
            ArrayError: shapes, dtypes or steps are not a frame's.
        """
        chosen, size, device = check_steps(steps), (self.height, self.width), self.device
        if self._done is not None:
            self._done.wait()  # until then the last frame's arrays are in use
        read, far = (3, chosen[2]) if older else (1, chosen[0])
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
        scanned = zip(
            (sources.colors, (sources.gbuffer,), (sources.nov,), sources.stencils, sources.normals), (3, 9, 1, 1, 3), strict=True
        )
        for which, (buffers, floats) in enumerate(scanned):
            for buffer in buffers:
                self.look_for_non_finite(buffer, floats, which)
        self.start(sources, tops, older=older)

    def look_for_non_finite(self, buffer: cl.Buffer, floats: int, which: int) -> None:
        """Have ``not_finite`` name ``FINITE[which]`` if one of the ``floats`` values of a pixel is not finite."""
        scan(self.device, self._finite, buffer, self.height * self.width * floats, self._bad, which)

    def start(
        self,
        sources: Sources,
        tops: Sequence[int] = (0,),
        *,
        older: bool = True,
        looking: bool = True,
    ) -> None:
        """``begin`` for what is on the device already, and known to be finite.

        Args:
            sources: the planes to read; kept until the next frame.
            tops: see ``begin``.
            older: False: the two older colour frames are not read, and ``inputs.earlier`` stays as it is.
            looking: use change maps; False: everything is computed, and nothing is marked.
        """
        self._read, self._tops, self._planes = sources, tuple(tops), 3 if older else 1
        self._looks = looking and bool(self._maps)
        newest, middle, oldest = sources.steps if older else (sources.steps[0], 0, 0)
        size, skip = (self.height, self.width), self._clear(newest > 0)
        if newest or oldest:
            motions = _filled_up(sources.motions, MOST_STEPS)
            self._run("chain_steps", size, *motions, newest, middle, oldest, self._chained, *self._splat, *size, *skip)
        for top in self._tops:
            self._warp(top)
        if newest > 0:
            self._run("splat_nearest", size, self._chained, sources.gbuffer, 9, 3, self._splat[0], *size)
            self._run("splat_first", size, self._chained, sources.gbuffer, 9, 3, *self._splat, *size)

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
            self._warp(top)  # an earlier strip's values have been overwritten
        size, inputs = (self.height, self.width), self.inputs
        if self._read.steps[0]:
            place = (*size, self.rows, self.columns, top)
            changes = (self._maps[0],) if self._looks else ()
            written = inputs.input.data, inputs.base
            self._run(
                "fill_holes",
                place[2:4],
                self._read.colors[0],
                self._chained,
                self._splat[1],
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

    def _clear(self, splats: bool) -> tuple[cl.Buffer, ...]:
        """Unmark all inputs; the map that tells a kernel where to compute."""
        if not self._looks or self._changes is None:
            return ()
        self._changes.clear()
        if splats:  # where nothing is dirty nobody clears them
            for buffer, value in zip(self._splat, (UNWANTED, NOBODY), strict=True):
                cl.enqueue_fill_buffer(self.device.queue, buffer, np.full(1, value, np.uint32), 0, buffer.size)
        return (self.dirty,)

    def _warp(self, top: int) -> None:
        """Warp the colour frames and find their holes; for the newest, mark the places that holes look up."""
        s, inputs = self._read, self.inputs
        assert s is not None
        place = (self.height, self.width, self.rows, self.columns, top)
        stencils, normals, positions = (_filled_up(of, 4) for of in (s.stencils, s.normals, s.positions))
        colors = *_filled_up(s.colors, 3), *s.steps
        read = *colors, self._chained, s.gbuffer, s.nov, *stencils, *normals, *positions, s.normal_stride
        written = self._splat[0], inputs.earlier.data, inputs.input.data, inputs.base, self.mask
        skip = (self.dirty, *self._maps[:2]) if self._looks else ()
        self._run("prepare", place[2:4], *read, *written, *place, *skip, planes=self._planes)

    def _run(
        self, name: str, size: tuple[int, int], *arguments: cl.Buffer | int | np.float32, planes: int | None = None
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
