# SPDX-License-Identifier: MIT
"""A renderer's files as display frames in the conventions of the specification."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from stss.frames.buffers import Buffers
from stss.frames.display_frame import WINDOW
from stss.images.color import BLOCK
from stss.images.headers import MAX_BYTES, MAX_SIDE, Header, read_header
from stss.images.windows import PixelWindow, union
from stss.sequence.background import (
    CameraError,
    MotionSource,
    background_motion,
    projection_of,
    projection_of_table,
    static_motion,
)
from stss.sequence.camera import CameraPose, camera_of, read_cameras
from stss.sequence.channels import MissingBuffersError, Source, find_sources, layers_of, view_of
from stss.sequence.conventions import linear_depth, require_depth, to_specification
from stss.sequence.find_profile import frames_of, require_fit, settle_profile
from stss.sequence.profiles import BUFFERS, CONSTANTS, Profile
from stss.sequence.projection import Projection
from stss.sequence.raw_frame import CARRIED, UNIT_RANGE, NonFinite, RawFrame, read_stored, settle_all_finite, settle_non_finite
from stss.sequence.solve_camera import MIN_PIXELS, solve_camera
from stss_ground.arguments import listing, path_of, require_choice, require_kind, suggest
from stss_ground.cores import for_blocks
from stss_ground.errors import InputError
from stss_ground.progress import Track
from stss_ref.arrays import Array, Mask

SURFACE = ("depth", "normal", "position")
"""Buffers without which a pixel shows no surface."""
MAX_RESIDUAL = 1e-2
"""Largest residual of a camera that is found from position and depth: the error of NoV is no larger."""


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
                f"{buffers.stencil[moves][0]:g}; write their motion into the files, or 0 as the stencil of what is at rest"
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
        others = self._carried(number, also) if color and "color" in frame.sources else {}
        arrays, carried = read_stored(frame, self.canvas, self.constants, others, color=color)
        if "motion" not in arrays:  # the camera gives it
            arrays["motion"] = np.full((*self.size, 2), self.profile.motion.bias, np.float32)
        require_depth(self._where(number), arrays["depth"], self.profile.depth)
        outside = self._outside(frame)
        if outside is not None:
            arrays["depth"] = np.where(outside[..., None], np.float32(np.nan), arrays["depth"])
        camera = frame.camera if "nov" in arrays or frame.camera is not None else self._solve(number, arrays)
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
        return () if number is None else tuple(self._carried(number, also))

    @property
    def alone(self) -> tuple[str, ...]:
        """Notes about files with several views or layers with a colour, if the user chose none."""
        return tuple(note for note in (self._one_view(), self._one_layer()) if note)

    def _one_layer(self) -> str:
        color = self.first.sources.get("color")
        if color is None:
            return ""
        first, *others = layers_of(read_header(color.path), self.profile, color)
        if not others:
            return ""
        return (
            f"layers: {color.path.name} has the colour of {', '.join([first, *others])}; only {first} is read: "
            "a profile with a base and the names of channels written out reads another"
        )

    def _one_view(self) -> str:
        frame = self.first
        views = tuple(dict.fromkeys(view for path in frame.files for view in read_header(path).views))
        if len(views) < 2 or self.profile.view or "color" not in frame.sources:
            return ""
        view = view_of(frame.sources["color"].names[0], views) or views[0]
        others = " or ".join(f'view = "{other}"' for other in views if other != view)
        return f"views: the files have {', '.join(views)}; only {view} is read: a profile with a base and {others} reads another"

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

    def _solve(self, number: int, arrays: dict[str, Array]) -> CameraPose:
        rule = self.profile.depth
        depth = linear_depth(arrays["depth"][..., 0], rule)
        if not np.isfinite(depth).any():  # a sky alone has NoV 0 from any place
            return CameraPose(np.zeros(3))
        camera = solve_camera(depth, arrays["position"], ray=rule.kind == "ray")
        if camera is None or camera.residual > MAX_RESIDUAL:
            reason = "too few surfaces" if camera is None else f"they differ by {camera.residual:.1g} of the distance"
            depths, counts = np.unique(depth[np.isfinite(depth)], return_counts=True)
            if len(depths) > 1 and depths[-1] > 2 * depths[-2] and counts[-1] >= MIN_PIXELS:
                reason += f"; {counts[-1]} pixels have depth {depths[-1]:g}: if nothing was hit there, give a profile with this background"
            raise InputError(
                f"{self._where(number)}: no nov and no camera, and position and depth do not give one ({reason}): give --camera CSV "
                f"(frame,x,y,z in the scene's unit) or a channel {' or '.join(names[0] for names in self.profile.channels['nov'])}, "
                "without which no orthographic camera can do"
            )
        return camera.pose

    def _carried(self, number: int, also: Collection[str]) -> dict[str, Source]:
        """The places of the planes that do not go through the network: alpha beside the colour, and the layers and channels in ``also``."""
        frame = self.frames[number]
        color = frame.sources["color"]
        there = {path: read_header(path).channels for path in frame.files}
        layer, red = color.names[0][:-1], color.names[0][-1]
        alpha = layer + {"R": "A", "r": "a"}.get(red, "")
        planes = {"A": Source(color.path, (alpha,))} if alpha in there[color.path] else {}
        own = {letter: Source(color.path, (full,)) for letter, full in zip("RGB", color.names, strict=True)}
        for name in also:
            sources = [
                Source(path, (full,))
                for path, names in there.items()
                for full in names
                if full == name or full.startswith(name + ".")
            ]
            if not sources:
                names = sorted({full for names in there.values() for full in names})
                near = suggest(name, [*names, *(full.rpartition(".")[0] for full in names)])
                raise InputError(f"{self._where(number)}: no layer or channel {name}; found {listing(names)}{near}")
            for source in sources:
                full = source.names[0]
                other = (own | planes).get(full, source)
                if other != source:
                    raise InputError(
                        f"{source.path}: --also {name}: channel {full} would take the place of {other.names[0]} of {other.path.name}"
                    )
                if full not in own:
                    planes[full] = source
        return planes

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


def open_sequence(
    path: str | Path,
    profile: str | Path | Profile | None = None,
    *,
    camera: Path | None = None,
    metallic: float | None = None,
    roughness: float | None = None,
    non_finite: NonFinite = "refuse",
    background: MotionSource = "files",
    static: MotionSource = "files",
    track: Track = iter,
    keep_going: bool = False,
) -> Sequence:
    """Find the frames of a sequence; reads headers, no pixels.

    Args:
        path: a folder with one sequence of EXR files, or a pattern like ``folder/name.####.exr``.
        profile: a built-in profile's name, a TOML file, or a profile; None: the built-in one whose channels the first frame has.
        camera: CSV of `read_cameras`, in the profile's unit of length; takes precedence over the camera in the files.
        metallic: constant for files that have no metallic, in [0, 1].
        roughness: the same for roughness.
        non_finite: the policy for non-finite colours, normals, base colours, roughness, metallic, NoV and stencils.
            "refuse": InputError; "mask": 0, and no later frame trusts such a colour.
        background: the source of the background's motion. "files": the files' motion. "camera": the rotation of the camera, which the
            positions of static geometry give (`stss.sequence.background`).
        static: the source of the motion of static geometry, whose stencil is 0. "files": the files' motion. "camera": the camera gives it,
            and that of the background; the files may have no motion.
        track: may show how many headers are read.
        keep_going: a frame whose headers cannot be read, or that has another size than the first, is an error when it is loaded, and
            not before.

    Returns:
        The frames; `Sequence` says what they hold.

    Raises:
        InputError: there is no sequence, frames differ in size, a constant is out of range, or a buffer is in no frame.
    """
    path = path_of("sequence", path)
    camera = None if camera is None else path_of("camera", camera)
    for name, value, choices in (
        ("non_finite", non_finite, get_args(NonFinite)),
        ("background", background, get_args(MotionSource)),
        ("static", static, get_args(MotionSource)),
    ):
        require_choice(name, value, choices)
    table = settle_profile(path, profile)
    cameras = None if camera is None else read_cameras(camera)
    constants = {**table.constants, **_constants(metallic=metallic, roughness=roughness)}
    files_by_number = frames_of(path, table)
    first: Header | None = None
    frames: dict[int, RawFrame] = {}
    for number in track(sorted(files_by_number)):
        try:
            headers = {ending: read_header(file) for ending, file in files_by_number[number].items()}
            for header in headers.values():
                first = first or header
                _require_window(header, first)
            frames[number] = _frame_of(number, headers, table, cameras, camera)
        except InputError as error:
            if not keep_going:
                raise
            frames[number] = RawFrame(tuple(files_by_number[number].values()), {}, None, fault=error)
    if first is None or all(frame.fault for frame in frames.values()):
        raise next(frame.fault for frame in frames.values() if frame.fault)
    canvas = _canvas(path, first.display, frames.values())
    _require_buffers(path, table, frames, {*constants, *(["motion"] if static == "camera" else [])})
    _require_fractions(next(frame for frame in frames.values() if frame.fault is None))
    settings = {
        "profile": hashlib.sha256(repr(replace(table, path=Path())).encode()).hexdigest(),
        "camera": None if camera is None else hashlib.sha256(camera.read_bytes()).hexdigest(),
        "constants": dict(sorted(constants.items())),
        "non_finite": non_finite,
        "background": background,
        "static": static,
        "windows": [canvas, first.display],
    }
    return Sequence(
        path,
        table,
        canvas=canvas,
        display=first.display,
        frames=frames,
        constants=constants,
        non_finite=non_finite,
        background=background,
        static=static,
        settings=settings,
        tables=(table.path,) if camera is None else (table.path, camera),
    )


@dataclass(frozen=True)
class SequenceOptions:
    """The arguments of `open_sequence` besides path and progress: the user's choices for reading a sequence."""

    profile: str | Path | Profile | None = None
    camera: Path | None = None
    metallic: float | None = None
    roughness: float | None = None
    non_finite: NonFinite = "refuse"
    background: MotionSource = "files"
    static: MotionSource = "files"

    def open(self, path: str | Path, track: Track = iter, *, keep_going: bool = False) -> Sequence:
        """Open a sequence with these choices; errors as of `open_sequence`."""
        return open_sequence(path, **vars(self), track=track, keep_going=keep_going)


def _constants(**values: float | None) -> dict[str, float]:
    """The values that the user chose, checked: buffer -> number."""
    constants = {buffer: value for buffer, value in values.items() if value is not None}
    for buffer, value in constants.items():
        require_kind(buffer, value, (int, float, np.floating), "a number from 0 to 1")
        if not 0 <= value <= 1:
            raise InputError(f"{buffer}: expected a number from 0 to 1, found {value}")
    return constants


def _require_window(header: Header, first: Header) -> None:
    """Raise InputError unless a file has the display window of the first one."""
    if header.display != first.display:
        window, size = (f"{h.display.width} x {h.display.height}" for h in (header, first))
        if window == size:
            window, size = (f"display window {h.display}" for h in (header, first))
        raise InputError(f"{header.path}: {window}; expected {size}, as {first.path.name} is")


def _frame_of(
    number: int,
    headers: Mapping[str, Header],
    profile: Profile,
    cameras: Mapping[int, CameraPose] | None,
    table: Path | None,
) -> RawFrame:
    sources = find_sources(headers, profile)
    files = tuple(header.path for header in headers.values())
    if cameras is None:
        where = next((x for x in (camera_of(header, profile) for header in headers.values()) if x is not None), None)
    elif number in cameras:
        where = cameras[number]
    else:
        raise InputError(f"{table}: no line for frame {number}")
    of_color = None if "color" not in sources else sources["color"].path
    last_wins = sorted(headers.values(), key=lambda header: header.path == of_color)
    attributes = {name: value for header in last_wins for name, value in header.attributes.items() if name in CARRIED}
    windows = {header.path: header.windows for header in headers.values()}
    data = {buffer: windows[source.path][source.names[0]] for buffer, source in sources.items()}
    return RawFrame(files, sources, where, attributes, data)


def _canvas(path: Path, display: PixelWindow, frames: Iterable[RawFrame]) -> PixelWindow:
    """The window that holds the display window and all pixels of all buffers."""
    canvas = union({display, *(window for frame in frames for window in frame.data.values())})
    if max(canvas.size) > MAX_SIDE or canvas.width * canvas.height * 4 * sum(BUFFERS.values()) > MAX_BYTES:
        raise InputError(f"{path}: data windows and display window {display} lie too far apart: together {canvas}")
    return canvas


def _require_fractions(frame: RawFrame) -> None:
    """Raise InputError if a plane that has fractions is stored in whole numbers, as renderers store object numbers."""
    headers = {source.path: read_header(source.path) for source in frame.sources.values()}
    for buffer, source in frame.sources.items():
        for name in source.names:
            if buffer not in CONSTANTS and headers[source.path].formats[name] == "uint32":
                raise InputError(
                    f"{source.path}: channel {name}: {buffer} is stored in whole numbers (uint); expected float or half"
                )


def _require_buffers(path: Path, profile: Profile, frames: Mapping[int, RawFrame], others: Collection[str]) -> None:
    """Raise InputError if no frame at all has some buffers: then the profile or the render is wrong, and no file is missing.

    ``others``: buffers that need no channel.
    """
    present = {*others, *(buffer for frame in frames.values() for buffer in frame.sources)}
    missing = [buffer for buffer in BUFFERS if buffer not in present and buffer != "nov"]  # which follows from position and depth
    if missing:
        sound = next(frame for frame in frames.values() if frame.fault is None)
        require_fit(path, profile, sound.sources)
        raise MissingBuffersError(path, profile, missing, sound.files, sound.sources)
