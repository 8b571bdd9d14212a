# SPDX-License-Identifier: MIT
"""The display frames of a sequence, read one by one, in the conventions of the specification."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from stss.frames.buffers import Buffers
from stss.frames.display_frame import WINDOW
from stss.images.color import BLOCK
from stss.images.windows import PixelWindow
from stss.sequence.background import (
    CameraError,
    MotionSource,
    background_motion,
    projection_of,
    projection_of_table,
    static_motion,
)
from stss.sequence.channels import MissingBuffersError, note_on_layers, note_on_views
from stss.sequence.conventions import require_depth, to_specification
from stss.sequence.profiles import BUFFERS, Profile
from stss.sequence.projection import Projection
from stss.sequence.raw_frame import (
    UNIT_RANGE,
    NonFinite,
    RawFrame,
    find_carried,
    read_stored,
    settle_all_finite,
    settle_non_finite,
)
from stss.sequence.solve_camera import solve_pose
from stss_ground.arguments import require_kind
from stss_ground.cores import for_blocks
from stss_ground.errors import InputError
from stss_ref.arrays import Mask

SURFACE = ("depth", "normal", "position")
"""Buffers without which a pixel shows no surface."""


@dataclass(eq=False)
class Sequence:
    """The display frames of a sequence; `open_sequence` makes one.

    Attributes:
        path: folder or pattern, as given.
        profile: the renderer's names and conventions.
        canvas: the pixels of every frame: the display window and the parts of data windows beyond it.
        display: the display window of every frame.
        frames: display frame -> its files, buffers and camera.
        constants: buffer -> number to use without a channel.
        non_finite, background, static: the policy for values that are not finite, and the sources of the motion of the background and
            of static geometry: see `open_sequence`.
        settings: everything besides the files on which `load` depends: text and numbers.
        tables: files that were read besides those of the frames: the profile's, the camera's.
    """

    path: Path
    profile: Profile
    canvas: PixelWindow
    display: PixelWindow
    frames: Mapping[int, RawFrame]
    constants: Mapping[str, float]
    non_finite: NonFinite
    background: MotionSource
    static: MotionSource
    settings: Mapping[str, object]
    tables: tuple[Path, ...]
    keeps: int = field(default=0, init=False, repr=False)
    """Bytes of frames that `load` may still keep, for callers that load frames several times and do not write to them."""
    _kept: dict[tuple[object, ...], Buffers] = field(default_factory=dict[tuple[object, ...], Buffers], init=False, repr=False)
    _projections: dict[int, Projection | None] = field(default_factory=dict[int, "Projection | None"], init=False, repr=False)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of every frame."""
        return self.canvas.size

    def crop_to_display(self, buffers: Buffers) -> Buffers:
        """A frame without its pixels beyond the display window."""
        if self.canvas == self.display:
            return buffers
        part = self.display.within(self.canvas)
        planes: dict[str, Any] = {name: plane[part] for name, plane in vars(buffers).items() if isinstance(plane, np.ndarray)}
        return replace(buffers, **planes, carried={name: plane[part] for name, plane in buffers.carried.items()})

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers of the display frames, sorted."""
        return tuple(sorted(self.frames))

    @property
    def rendered(self) -> frozenset[int]:
        """The frames that have a colour. One that cannot be read counts among them: without it every frame would be a rendered one."""
        return frozenset(number for number, frame in self.frames.items() if "color" in frame.sources or frame.fault)

    @property
    def first(self) -> RawFrame:
        """The first frame that can be read."""
        return next(frame for number in self.numbers if (frame := self.frames[number]).fault is None)

    def has(self, number: int, buffer: str) -> bool:
        """Whether a buffer of a frame is in the frame's files, is a constant, or can be computed."""
        frame = self._frame(number)
        computed = (buffer == "nov" and (frame.camera is not None or {"depth", "position"} <= frame.sources.keys())) or (
            buffer == "motion" and self.static == "camera"
        )
        return buffer in frame.sources or buffer in self.constants or computed

    def files(self, number: int) -> tuple[Path, ...]:
        """The files of a frame, which `load` reads, and no others."""
        return self._frame(number).files

    @property
    def reads(self) -> tuple[Path, ...]:
        """Every file that the sequence reads."""
        return (*self.tables, *self.images)

    @property
    def images(self) -> tuple[Path, ...]:
        """Every file of a frame."""
        return tuple(path for frame in self.frames.values() for path in frame.files)

    def part(self, numbers: Collection[int]) -> Sequence:
        """The sequence with only the frames of ``numbers`` and the first that can be read, which decides for all of them."""
        selection, first = copy(self), self.first
        selection.frames = {number: frame for number, frame in self.frames.items() if number in numbers or frame is first}
        return selection

    def load(self, number: int, *, color: bool = True, also: Collection[str] = (), cut: bool = False) -> Buffers:
        """Read one display frame.

        Args:
            number: the display frame.
            color: False: leave the colour out, as if the frame had not been rendered.
            also: names of layers or channels that are warped and enlarged with the colour, like its alpha.
            cut: True for the first frame of a shot. No output uses its motion, so the camera need not give that.

        Returns:
            The frame in the conventions of spec section 0.

        Raises:
            InputError: the frame or a buffer of it is not there, a file cannot be read, or a value is not finite where
                it must be; `CameraError`: the camera that should give its motion is not known.
        """
        require_kind("number", number, (int, np.integer), "a frame's number")
        key = number, color, *also
        if key in self._kept:
            return replace(self._kept[key], cut=True) if cut else self._kept[key]
        buffers = self._load(number, color=color, also=also)
        by_camera = number - 1 in self.frames and (
            self.static == "camera" or (self.background == "camera" and bool(np.isinf(buffers.depth).any()))
        )
        if by_camera and not cut:
            self._set_motion(buffers)
        size = sum(plane.nbytes for plane in vars(buffers).values() if isinstance(plane, np.ndarray))
        if size <= self.keeps and not (by_camera and cut):
            self._kept[key] = buffers
            self.keeps -= size
        return replace(buffers, cut=True) if cut else buffers

    def _set_motion(self, buffers: Buffers) -> None:
        """Set the motion that the camera gives; leave it if the frame before, without which no output uses it, cannot be read."""
        try:
            before = self._projection(buffers.number - 1)
        except InputError:
            return
        now, moves = self._projection(buffers.number, buffers), buffers.stencil != 0
        option = "--background camera" if self.static == "files" else "--static camera"
        if self.static == "camera" and "motion" not in self._frame(buffers.number).sources and moves.any():
            raise InputError(
                f"{self._where(buffers.number)}: {option}: no motion for objects whose stencil is not 0, the first "
                f"{buffers.stencil[moves][0]:g}; write their motion into the files, or 0 as the stencil of surfaces at rest"
            )
        if before is None or now is None:
            number = buffers.number - (now is not None)
            raise CameraError(
                f"{self._where(buffers.number)}: {option}: positions of static geometry in frame {number} do not give the "
                "camera: too few, or all in one plane; let static geometry off the plane be seen, give a --camera table with its "
                f"directions, or write the motion into the files; if a shot begins with frame {buffers.number}, name it in --cuts"
            )

        def fill(rows: slice) -> None:
            background = ~np.isfinite(buffers.depth[rows])
            y, x = np.nonzero(background)
            buffers.motion[rows][background] = background_motion(before, now, np.stack([x, y + rows.start], axis=-1))
            if self.static == "camera":
                rests = ~(background | moves[rows])
                buffers.motion[rows][rests] = static_motion(before, now, buffers.position[rows][rests])

        for_blocks(self.size[0], max(1, BLOCK // self.size[1]), fill)

    def _projection(self, number: int, buffers: Buffers | None = None) -> Projection | None:
        """A frame's projection, of the camera's table if it has one; the last few are kept."""
        if number not in self._projections:
            self._projections = {n: projection for n, projection in self._projections.items() if abs(n - number) <= WINDOW}
            camera = self._frame(number).camera
            if camera is not None and camera.far is not None:
                place = camera.position / self.profile.units_per_cm
                self._projections[number] = projection_of_table(camera.far, place, self.display, self.canvas)
                return self._projections[number]
            self._projections[number] = projection_of(buffers or self._load(number, color=False))
        return self._projections[number]

    def _load(self, number: int, *, color: bool = True, also: Collection[str] = ()) -> Buffers:
        """The frame with the motion that its files have."""
        frame = self._frame(number)
        if frame.fault is not None:
            raise frame.fault
        if missing := [buffer for buffer in BUFFERS if buffer != "color" and not self.has(number, buffer)]:
            raise MissingBuffersError(self._where(number), self.profile, missing, frame.files, frame.sources)
        others = find_carried(self._where(number), frame, also) if color else {}
        arrays, carried = read_stored(frame, self.canvas, self.constants, others, color=color)
        if "motion" not in arrays:  # the camera gives it
            arrays["motion"] = np.full((*self.size, 2), self.profile.motion.bias, np.float32)
        require_depth(self._where(number), arrays["depth"], self.profile.depth)
        outside = self._outside(frame)
        if outside is not None:
            arrays["depth"] = np.where(outside[..., None], np.float32(np.nan), arrays["depth"])
        camera = frame.camera
        if camera is None and "nov" not in arrays:
            camera = solve_pose(self._where(number), arrays, self.profile)
        depth = to_specification(arrays, self.profile, camera, display=self.display.size, outside=outside, in_place=True)
        settle_non_finite(arrays, frame.sources, self.non_finite)
        settle_all_finite(carried, others, self.non_finite, into=carried)
        for buffer in UNIT_RANGE:
            np.clip(arrays[buffer], 0, 1, out=arrays[buffer])
        return Buffers(
            number=number,
            color=arrays.get("color"),
            motion=arrays["motion"],
            normal=arrays["normal"],
            depth=depth,
            position=arrays["position"],
            stencil=arrays["stencil"][..., 0],
            nov=arrays["nov"][..., 0],
            base_color=arrays["base_color"],
            roughness=arrays["roughness"][..., 0],
            metallic=arrays["metallic"][..., 0],
            carried=carried,
        )

    def carries(self, also: Collection[str] = ()) -> tuple[str, ...]:
        """Names of the planes that are carried with the colour of the first rendered frame, see `load`."""
        number = next((number for number in self.numbers if "color" in self.frames[number].sources), None)
        return () if number is None else tuple(find_carried(self._where(number), self.frames[number], also))

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes about files with several views or layers with a colour, if the user chose none."""
        if "color" not in self.first.sources:
            return ()
        color = self.first.sources["color"]
        return tuple(filter(None, (note_on_views(self.first.files, self.profile, color), note_on_layers(self.profile, color))))

    @property
    def solves_camera(self) -> bool:
        """Whether the camera is found from position and depth: the files have neither a camera nor NoV."""
        frame = self.first
        return frame.camera is None and "nov" not in frame.sources

    def _outside(self, frame: RawFrame) -> Mask | None:
        """(H, W) True where depth, normal or position has no pixels; None: all have pixels everywhere."""
        windows = {frame.data[buffer] for buffer in SURFACE if buffer in frame.data}
        if windows <= {self.canvas}:
            return None
        return ~np.logical_and.reduce([window.mask(self.canvas) for window in windows])

    def require(self, numbers: Iterable[int]) -> None:
        """Raise InputError if one of these display frames has no file."""
        missing = [n for n in numbers if n not in self.frames]
        if missing:
            others = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
            raise InputError(
                f"{self.path}: frame {missing[0]}{others}: not there; STSS needs the G-buffer and motion of every display frame, "
                "rendered or not"
            )

    def _frame(self, number: int) -> RawFrame:
        self.require([number])
        return self.frames[number]

    def _where(self, number: int) -> str:
        return str(self.frames[number].files[0]) if len(self.frames[number].files) == 1 else f"{self.path}: frame {number}"
