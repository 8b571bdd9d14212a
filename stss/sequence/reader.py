# SPDX-License-Identifier: MIT
"""Open a sequence: find a renderer's files, and what each holds, by headers alone."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from stss.images.headers import MAX_BYTES, MAX_SIDE, Header, read_header
from stss.images.windows import PixelWindow, union
from stss.sequence.background import MotionSource
from stss.sequence.camera import CameraPose, camera_of, read_cameras
from stss.sequence.channels import MissingBuffersError, find_sources
from stss.sequence.find_profile import frames_of, require_fit, settle_profile
from stss.sequence.profiles import BUFFERS, CONSTANTS, Profile
from stss.sequence.raw_frame import CARRIED, NonFinite, RawFrame
from stss.sequence.sequence import Sequence
from stss_ground.arguments import path_of, require_choice, require_kind
from stss_ground.errors import InputError
from stss_ground.progress import Track


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
