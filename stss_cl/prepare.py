# SPDX-License-Identifier: MIT
"""Everything of a frame that comes before the network, fused: motion chain, warp, holes, occlusion warp, packing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyopencl as cl

from stss_cl.buffers import Inputs, inputs_for
from stss_cl.device import Device
from stss_cl.image_stages import LIMITS, Gather, kernels, launch
from stss_cl.program import build
from stss_ref.arrays import Array, ArrayError, require_dtype, require_shape

Source = Array | cl.Buffer
"""A C-contiguous float32 array, or a buffer on the device that holds one."""


FINITE = ("colors", "gbuffer", "nov", "stencils", "normals")
"""The arrays that must be finite: a NaN would end as 0 in some ReLU, unseen."""
SCANNERS = 64
"""Work-items that look for what is not finite."""


class Prepare:
    """The kernels and buffers of one size of frame; the same values as ``stss_ref.frame.prepare`` in float32.

    Args:
        device: to run on.
        height, width: of the frames.
        gather: how the motion chain reads between pixels.
        eights: a work-item computes eight pixels in a row; None: on processors.
        inputs: what to write to; None: buffers of its own.

    Attributes:
        inputs: what the network is given, on the device; every frame writes to the same buffers.
        mask: (H, W) uint8, 1 = not a hole of the newest colour frame.
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
        half = self.inputs.input.dtype == np.float16
        options = {"GATHER": f"gather_{gather}", "HALF": half, **LIMITS}
        self._kernels = kernels(device, "frame8.cl" if eights else "frame.cl", options)
        if gather != "longest":
            self._kernels.pop("chain_steps8", None)  # its gather is that one
        eighth = build(device, "erm.cl", {"KEYS": 32, "VALUES": 64, "MASK": "uchar", "HALF": half})
        self._downsample = cl.Kernel(eighth, "downsample_8")
        self.mask = self._zeros(height * width)
        self._chained = self._zeros(3 * height * width * 2 * 4)
        self._finite, self._bad = cl.Kernel(build(device, "finite.cl"), "finite"), self._zeros(4 * len(FINITE))
        self._splat = self._zeros(height * width * 4), self._zeros(height * width * 4)
        self._held: tuple[cl.Buffer, ...] = ()
        self._done: cl.Event | None = None

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
    ) -> None:
        """Enqueue the frame's image-space stages up to the splat; the arguments are those of ``stss_ref.frame.FrameInputs``.

        ``strip`` then finishes each of the strips that begin at ``tops``.

        Arrays are read in place on a processor: they must stay as they are until the queue has done this frame. All but motions
        and positions must be finite: ``not_finite`` says afterwards.

        Raises:
            ArrayError: shapes, dtypes or steps are not a frame's.
        """
        newest, middle, oldest = self._check_steps(steps)
        height, width = size = self.height, self.width
        if self._done is not None:
            self._done.wait()  # until then the last frame's arrays are in use
        color = self._source("colors", colors, (3, height, width, 3))
        motion = self._source("motions", motions, (None, height, width, 2), oldest) if oldest else self._chained
        g = self._source("gbuffer", gbuffer, (height, width, 9))
        n = self._source("nov", nov, (height, width))
        stencil = self._source("stencils", stencils, (4, height, width))
        normal = self._source("normals", normals, (4, height, width, 3))
        position = self._source("positions", positions, (4, height, width, 3))
        self._held = (color, motion, g, n, stencil, normal, position)
        sizes = (9, 9, 1, 4, 12)  # floats a pixel of each of FINITE
        for i, (buffer, floats) in enumerate(zip((color, g, n, stencil, normal), sizes, strict=True)):
            count = np.uint64(height * width * floats)
            self._finite(self.device.queue, (SCANNERS,), None, buffer, count, self._bad, np.int32(i))

        chosen = (newest, middle, oldest)
        if oldest > 0:
            self._run("chain_steps", size, motion, *chosen, self._chained, *self._splat, *size)
        self._read = (color, *chosen, self._chained, g, n, stencil, normal, position)
        self._tops = tuple(tops)
        for top in self._tops:
            self._warp(top)
        if newest > 0:
            self._run("splat_nearest", size, self._chained, g, 9, 3, self._splat[0], *size)
            self._run("splat_first", size, self._chained, g, 9, 3, *self._splat, *size)

    def not_finite(self) -> str | None:
        """Name of an array of the frame begun last that had to be finite and was not; waits for the queue."""
        bad = np.empty(len(FINITE), np.int32)
        cl.enqueue_copy(self.device.queue, bad, self._bad)
        if not bad.any():
            return None
        cl.enqueue_fill_buffer(self.device.queue, self._bad, np.zeros(1, np.int32), 0, bad.nbytes)
        return FINITE[int(bad.argmax())]

    def strip(self, top: int = 0) -> None:
        """Enqueue what is left to do for the rows of ``inputs`` that begin at row ``top`` of the frame, one of ``begin``'s."""
        if len(self._tops) > 1:
            self._warp(top)  # the strips before it have been written over
        color, newest, g, size = self._read[0], self._read[1], self._read[5], (self.height, self.width)
        if newest:
            place = (*size, self.rows, self.columns, top)
            written = self.inputs.input.data, self.inputs.base
            self._run("fill_holes", place[2:4], color, self._chained, self._splat[1], self.mask, *written, *place)
        eighth = self.inputs.eighth
        numbers = (np.int32(n) for n in (*size, eighth.columns, top))
        shape = (eighth.width, eighth.height)
        self._done = self._downsample(self.device.queue, shape, None, g, self.mask, eighth.data, *numbers)

    def _warp(self, top: int) -> None:
        """Warp and judge the three frames; for the newest, mark the places that holes look up."""
        written = self.inputs.earlier.data, self.inputs.input.data, self.inputs.base, self.mask
        place = (self.height, self.width, self.rows, self.columns, top)
        self._run("prepare", place[2:4], *self._read, self._splat[0], *written, *place, planes=3)

    def _run(self, name: str, size: tuple[int, int], *arguments: cl.Buffer | int, planes: int | None = None) -> cl.Event:
        """Enqueue a kernel over ``size`` (rows, columns), eight pixels to a work-item if there is one that does so."""
        kernel, (rows, columns) = self._kernels[name], size
        if eight := self._kernels.get(f"{name}8"):
            kernel, columns = eight, -(-columns // 8)
        return launch(self.device, kernel, columns, rows, *arguments, planes=planes)

    def _source(self, name: str, source: Source, shape: tuple[int | None, ...], least: int = 1) -> cl.Buffer:
        """``source`` on the device: itself, the array in place, or a copy."""
        if isinstance(source, cl.Buffer):
            expected = int(np.prod([least if n is None else n for n in shape])) * 4
            if source.size < expected:
                raise ArrayError(f"{name}: expected at least {expected} bytes, got {source.size}")
            return source
        require_shape(name, source, shape)
        require_dtype(name, source, np.dtype(np.float32))
        if len(source) < least:
            raise ArrayError(f"{name}: expected at least {least}, got {len(source)}")
        in_place = self.device.is_cpu and source.flags.c_contiguous and source.ctypes.data % 8 == 0
        flags = cl.mem_flags.USE_HOST_PTR if in_place else cl.mem_flags.COPY_HOST_PTR
        return cl.Buffer(self.device.context, cl.mem_flags.READ_ONLY | flags, hostbuf=np.ascontiguousarray(source))

    def _zeros(self, size: int) -> cl.Buffer:
        buffer = cl.Buffer(self.device.context, cl.mem_flags.READ_WRITE, size)
        cl.enqueue_fill_buffer(self.device.queue, buffer, np.zeros(1, np.uint8), 0, size)
        return buffer

    @staticmethod
    def _check_steps(steps: Sequence[int]) -> tuple[int, int, int]:
        given = tuple(int(step) for step in steps)
        if len(given) != 3 or list(given) != sorted(given) or given[0] < 0:
            raise ArrayError(f"steps: expected three numbers >= 0, newest (smallest) first, got {given}")
        return given
