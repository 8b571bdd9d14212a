# SPDX-License-Identifier: MIT
"""The stages of a frame before the network, fused: motion chain, warp, holes and their fill, packing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import Inputs, inputs_for
from stss_cl.device.conversion import storage_options
from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil_div, grid
from stss_cl.device.launch import Arguments, Kernel, Launch
from stss_cl.device.parts import make_zeros
from stss_cl.device.program import Program, marking, program_for
from stss_cl.image_space.frame_planes import MOST_STEPS, Source, Sources, check_steps, planes, upload
from stss_cl.image_space.stages import hole_options, program
from stss_ref.constants import HoleFill, HoleTest
from stss_ref.weights import SecondColor

FINITE = ("colors", "gbuffer", "nov", "stencils", "normals")
"""The arrays that must be finite: a ReLU could turn a NaN into 0 unnoticed."""

STRIP_MARGIN = 8
"""Rows whose lights a strip needs besides its own, as in kernels/reshade.clh; a multiple of 8."""
MOTIONS = tuple(f"motion{i}" for i in range(MOST_STEPS))
NOTHING = {"height": 0, "rows": 0, "down": 0}
"""With these arguments a kernel has no pixel, and does no work."""


@dataclass(frozen=True)
class _Launches:
    """The launches of one frame.

    ``colors``: of the colour frames, newest first; ``search``: for the colours of holes; ``fill``: of the holes of
    the newest frame's strip.
    """

    chain: Launch
    colors: tuple[Launch, ...]
    search: tuple[Launch, ...]
    fill: tuple[Launch, ...]
    eighth: Launch


@dataclass(frozen=True)
class PrepareOptions:
    """The choices for a frame.

    Attributes:
        second, test, hole_fill: the network's second colour, the hole test and the fill of holes, see ``stss_ref.frame.prepare``.
        frames: the number of colour frames that are read, from the newest on: 1 or 3. With 1 ``inputs.earlier`` is not written.
        history: whether ``inputs.earlier`` is read; if not, it is not written, and no older frame is searched for holes.
    """

    second: SecondColor = "newest"
    test: HoleTest = "footprint"
    hole_fill: HoleFill = "occlusion_warp"
    frames: int = 3
    history: bool = True


class Prepare:
    """The launches and buffers of one size of frame; the same values as ``stss_ref.frame.prepare`` in float32.

    Args:
        device: to run on.
        height, width: of the frames.
        options: its choices; None: the defaults.
        inputs: buffers to write to; None: buffers of its own. If they have change maps, only ``dirty`` tiles are computed.
        tops: the rows of the frame at which the strips of ``inputs`` begin.

    Attributes:
        inputs: the network's inputs on the device; every frame writes to the same buffers.
        mask: (H, W) uint8, 1 = not a hole of the newest colour frame.
        splat: (2, H, W) uint32, see kernels/frame.cl; ``prepare_newest`` marks the places that holes look up as wanted, and
            ``fill_holes`` resets them.
        dirty: a byte for each 4 x 4 pixels of ``inputs.input``: 0: the inputs there are those of the last frame, and no hole is filled.
    """

    def __init__(
        self,
        device: Device,
        height: int,
        width: int,
        options: PrepareOptions | None = None,
        *,
        inputs: Inputs | None = None,
        tops: Sequence[int] = (0,),
    ) -> None:
        options = PrepareOptions() if options is None else options
        self.device, self.height, self.width = device, height, width
        self._frames, self._tops, self._is_detailed = options.frames, tuple(tops), options.second == "detail"
        self._stores = options.history and options.frames == 3
        self._test: HoleTest = options.test
        self._reshades = options.hole_fill == "reshade"
        rows, columns = ceil_div(height, 8) * 8, ceil_div(width, 8) * 8
        self.inputs = inputs_for(device, rows, columns, np.dtype(np.float32)) if inputs is None else inputs
        self.rows, self.columns = self.inputs.input.height, columns  # of a strip, if the frame is computed in strips
        self.mask = self._filled(height * width)
        self.dirty = self._filled(self.rows // 4 * (columns // 4), 1)
        self._motions = make_zeros(device, 3 * height * width * 8)
        self._bad = self._filled(4 * len(FINITE))
        self.splat = self._filled(8 * (1 if self._reshades else height * width))
        self._samples, self._lights = (self._filled((height * width if self._reshades else 1) * 16) for _ in range(2))
        self._launches = self._whole if self.inputs.changes is None else self._marking
        self._sources: Sources | None = None
        self._last: cl.Event | None = None

    @cached_property
    def _whole(self) -> _Launches:
        """The launches that compute everything."""
        return self._make(marks=False)

    @cached_property
    def _marking(self) -> _Launches:
        """The launches that compute only dirty tiles, and mark those that changed."""
        return self._make(marks=True)

    def _programs(self, *, marks: bool) -> tuple[Program, Program]:
        """Those of frame.cl and downsample_8.cl."""
        options = {**storage_options(self.device, self.inputs.input.dtype), **marking(self.device, marks)}
        frame_options = {
            "EIGHT_PIXELS": self.device.is_cpu,
            **options,
            **hole_options(self._test),
            "STREAM": self.device.is_pocl_processor,
            "DETAIL": self._is_detailed,
            "RESHADE": self._reshades,
        }
        frame = program(self.device, "frame.cl", frame_options)
        return frame, program_for(self.device, "downsample_8.cl", {"MASK": "uchar", **options})

    def _make(self, *, marks: bool) -> _Launches:
        inputs, (height, width) = self.inputs, (self.height, self.width)
        frame, eighth = self._programs(marks=marks)
        changes = inputs.changes if marks else None
        dirty, maps, eighth_map = (None, None, None) if changes is None else (self.dirty, changes.whole, changes.buffers[2])
        size = {"height": height, "width": width}
        task = {
            **size, "rows": self.rows, "columns": self.columns, "history_map": 0 if changes is None else changes.firsts[1],
            "is_missing": False, "checks": False, "stores": self._stores, "marks_wanted": False, "image": 2,
            "reads_middle": False, "reads_oldest": False,
        }  # fmt: skip
        outputs = {"history": inputs.earlier.data, "bad": self._bad, "dirty": dirty}
        newest = {"x0": inputs.input.data, "color3": inputs.base, "mask": self.mask, "splat": self.splat}
        found = {"color3": inputs.base, "mask": self.mask, "samples": self._samples, "lights": self._lights}
        marked = {"changes": maps}
        small = {
            "mask": self.mask, "eighth": inputs.eighth.data, "down": inputs.eighth.height, "across": inputs.eighth.width,
            "columns": inputs.eighth.columns, "changes": eighth_map, "dirty": dirty,
        }  # fmt: skip
        across = 8 if self.device.is_cpu else 1

        def launch(name: str, columns: int, rows: int, *groups: Arguments, of: Program = frame) -> Launch:
            arguments = {argument: value for group in groups for argument, value in group.items()}
            return Launch(name, Kernel(of, name, arguments), arguments, *grid(self.device, columns, rows))

        whole, part = (ceil_div(width, across), height), (ceil_div(self.columns, across), self.rows)
        if self._reshades:
            search = (launch("find_samples", *whole, {"mask": self.mask, "samples": self._samples, "top": 0}, task),)
        else:
            search = tuple(launch(name, *whole, {"splat": self.splat}, size) for name in ("splat_nearest", "splat_first"))
        return _Launches(
            chain=launch("chain_steps", *whole, {"motions": self._motions, "dirty": dirty}, size),
            colors=(
                launch("prepare_newest", *part, outputs, newest, marked, task),
                *(launch("prepare_older", *part, outputs, marked, task, {"image": image}) for image in (1, 0) if self._stores),
            ),
            search=search,
            fill=(
                *((launch("find_lights", whole[0], self.rows + STRIP_MARGIN, found, task),) if self._reshades else ()),
                launch("fill_holes", *part, newest, marked, {"lights": self._lights}, task),
            ),
            eighth=launch("downsample_8", inputs.eighth.width, inputs.eighth.height, small, size, of=eighth),
        )

    def load(self) -> None:
        """Let the runtime load or compile all kernels."""
        for launches in (self._whole,) if self.inputs.changes is None else (self._whole, self._marking):
            for launch in (launches.chain, *launches.colors, *launches.search, *launches.fill, launches.eighth):
                launch.load(self.device.queue, **{name: none for name, none in NOTHING.items() if name in launch.arguments})

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
    ) -> None:
        """Enqueue the frame's image-space stages up to the search for the colours of holes; arguments as of ``stss_ref.frame.FrameInputs``.

        ``strip`` then finishes each of the strips. On a CPU arrays are read in place: they must not change until the queue has
        finished this frame. All but motions and positions must be finite: ``not_finite`` checks those that are read afterwards.

        Raises:
            ArrayError: shapes, dtypes or steps are not a frame's.
        """
        distances, size, device, frames = check_steps(steps), (self.height, self.width), self.device, self._frames
        surfaces = 4 if self._stores else 2
        if self._last is not None:
            self._last.wait()  # until then the previous frame's arrays are in use
        far = distances[frames - 1]
        sources = Sources(
            steps=distances,
            colors=planes(device, "colors", colors, frames, (*size, 3), stack=3),
            motions=planes(device, "motions", motions, far, (*size, 2), stack=None) if far else (),
            gbuffer=upload(device, "gbuffer", gbuffer, (*size, 9)),
            nov=upload(device, "nov", nov, size),
            stencils=planes(device, "stencils", stencils, frames + 1, size, stack=4),
            normals=planes(device, "normals", normals, surfaces, (*size, 3), stack=4),
            positions=planes(device, "positions", positions, surfaces, (*size, 3), stack=4),
        )
        self.start(sources, checks=True)

    def start(self, sources: Sources, *, looking: bool = True, checks: bool = False) -> None:
        """``begin`` for planes that are on the device already, and known to be finite.

        Args:
            sources: the planes to read; kept until the next frame.
            looking: use change maps; False: everything is computed, and nothing is marked.
            checks: let ``not_finite`` look for values that are not finite; normals are then three floats apart.
        """
        self._sources, s, changes = sources, sources, self.inputs.changes
        self._launches = launches = self._marking if looking and changes is not None else self._whole
        if looking and changes is not None:
            changes.clear()
        steps = dict(zip(("newest", "middle", "oldest"), (*s.steps[: self._frames], 0, 0), strict=False))
        # A chain of one motion is that motion. With change maps it is written all the same: a later frame may read it.
        is_chain = changes is not None or self._frames > 1 or s.steps[0] > 1
        if any(steps.values()) and is_chain:
            chain = (*s.motions, *MOST_STEPS * s.motions[-1:])  # the last one takes the place of those that no step needs
            launches.chain.set(**dict(zip(MOTIONS, chain, strict=False)), **steps)
            launches.chain.enqueue(self.device.queue)
        motions = self._motions if is_chain or not s.steps[0] else s.motions[0]
        surface = {
            "gbuffer": s.gbuffer, "nov": s.nov, "stencil": s.stencils[0], "normal": s.normals[0], "position": s.positions[0],
            "normal_stride": s.normal_stride, "motions": motions,
        }  # fmt: skip
        of_newest = (launches.fill[-1], *(launches.search if self._reshades else ()))
        for launch, i in (*zip(launches.colors, range(3), strict=False), *((launch, 0) for launch in of_newest)):
            launch.set(
                **surface, color=s.colors[i], is_warped=s.steps[i] > 0, stencil_previous=s.stencils[i + 1],
                normal_previous=s.normals[i + 1], position_previous=s.positions[i + 1],
            )  # fmt: skip
        for launch, (newer, older) in zip(launches.colors[1:], pairwise(s.steps), strict=False):
            launch.set(is_missing=newer == older)
        if self._reshades:
            read = ("gbuffer", "stencil", "normal", "normal_stride", "motions")
            launches.fill[0].set(**{name: surface[name] for name in read}, color=s.colors[0], is_warped=s.steps[0] > 0)
        if self._is_detailed:
            for launch in (launches.colors[0], launches.fill[-1]):
                launch.set(
                    middle_color=s.colors[1], oldest_color=s.colors[2], stencil_middle=s.stencils[2], stencil_oldest=s.stencils[3],
                    reads_middle=s.steps[1] > s.steps[0], reads_oldest=s.steps[2] > s.steps[1],
                )  # fmt: skip
        for top in self._tops:
            self._warp(top, checks=checks, marks_wanted=not self._reshades)
        for launch in launches.search if s.steps[0] else ():
            if not self._reshades:
                launch.set(motions=motions, gbuffer=s.gbuffer)
            launch.enqueue(self.device.queue)
        launches.eighth.set(gbuffer=s.gbuffer)

    def not_finite(self) -> str | None:
        """Name of a non-finite array of the frame begun last, if it must be finite; None: all are finite. Waits for the queue."""
        bad = np.empty(len(FINITE), np.int32)
        cl.enqueue_copy(self.device.queue, bad, self._bad)
        if not bad.any():
            return None
        cl.enqueue_fill_buffer(self.device.queue, self._bad, np.zeros(1, np.int32), 0, bad.nbytes)
        return FINITE[int(bad.argmax())]

    def strip(self, top: int = 0) -> None:
        """Enqueue the rest of the work for the rows of ``inputs`` that begin at row ``top`` of the frame, one of ``tops``."""
        assert self._sources is not None
        if len(self._tops) > 1:
            self._warp(top, checks=False, marks_wanted=False)  # an earlier strip's values have been overwritten
        if self._sources.steps[0]:
            for launch in self._launches.fill:
                launch.set(top=top)
                launch.enqueue(self.device.queue)
        self._launches.eighth.set(top=top)
        self._last = self._launches.eighth.enqueue(self.device.queue)

    def _warp(self, top: int, *, checks: bool, marks_wanted: bool) -> None:
        """Warp the colour frames that are read, and find their holes; for the newest, mark the places that holes look up.

        ``checks``: look for values that are not finite; ``marks_wanted``: False if the places were marked before.
        """
        self._launches.colors[0].set(marks_wanted=marks_wanted)
        for launch in self._launches.colors:
            launch.set(top=top, checks=checks)
            launch.enqueue(self.device.queue)

    def _filled(self, size: int, value: int = 0) -> cl.Buffer:
        buffer = cl.Buffer(self.device.context, cl.mem_flags.READ_WRITE, size)
        cl.enqueue_fill_buffer(self.device.queue, buffer, np.full(1, value, np.uint8), 0, size)
        return buffer
