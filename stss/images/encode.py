# SPDX-License-Identifier: MIT
"""EXR and PNG as bytes. OpenImageIO reports success even where it cut a file short, so its result is checked."""

from __future__ import annotations

import io
import os
import struct
import tempfile
from collections.abc import Collection, Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio  # noqa: N813

from stss.images.headers import Value, last_error, whole_png
from stss.images.windows import PixelWindow
from stss_ground.errors import InputError
from stss_ref.arrays import Array

HALF_MAX = 65504.0
_TYPES = {
    "framesPerSecond": "rational",
    "FramesPerSecond": "rational",
    "smpte:TimeCode": "timecode",
    "worldToCamera": "matrix",
    "worldToNDC": "matrix",
}
"""Metadata of several numbers -> OpenImageIO's type; the others are floats."""
_OF_A_SCENE = ("oiio:ColorSpace", "chromaticities", "whiteLuminance")
"""Metadata of scene-linear colour. In a PNG, a viewer would take this linear space for that of the pixels, and show them washed out."""

_CHUNK_LINES = 16
"""Lines that EXR's ``zip`` compresses together."""
_LINES = 4 * _CHUNK_LINES
"""Lines to write at once, so few that they stay in the processor's cache."""
_PNG = {"png:compressionLevel": 3, "png:filter": 16}
"""A quarter of the time of zlib's usual level with all filters, for files that are 4 to 17 % larger; 16 is PNG's filter *Sub*."""
Pixels = Array | np.ndarray[Any, Any]


def encode_exr(
    path: Path,
    names: tuple[str, ...],
    pixels: Array | Sequence[Array],
    half: Collection[str],
    metadata: Mapping[str, Value],
    windows: tuple[PixelWindow, PixelWindow] | None = None,
) -> bytes:
    """Encode an EXR (zip).

    Args:
        path: where it will lie, for messages.
        names: the channels' names.
        pixels: (H, W, C) float32, or several arrays that have the channels one behind the other.
        half: channels that are stored as half unless a value exceeds half's range; the others are float.
        metadata: name -> value.
        windows: data window, of the pixels' size, and display window; None: both begin at 0.

    Raises:
        InputError: memory or the limit on the size of files does not suffice.
        ValueError: a value is not finite.
    """
    parts = (pixels,) if isinstance(pixels, np.ndarray) else tuple(pixels)
    (height, width), first = parts[0].shape[:2], 0
    for part in parts:
        require_finite(path, names[first : first + part.shape[2]], part)
        first += part.shape[2]
    all_fit = all(_is_half(part) for part in parts)  # of all at once, since one channel alone takes as long
    fits = [all_fit or _is_half(part[..., i]) for part in parts for i in range(part.shape[2])]
    formats = ["half" if name in half and small else "float" for name, small in zip(names, fits, strict=True)]
    spec = oiio.ImageSpec(width, height, len(names), formats[0])
    if windows is not None:
        data, display = windows
        spec.x, spec.y = data.x, data.y
        spec.full_x, spec.full_y, spec.full_width, spec.full_height = display
    spec.channelnames = names
    if len({*formats}) > 1:  # OpenImageIO ignores formats that are all the same
        spec.channelformats = tuple(oiio.TypeDesc(name) for name in formats)
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "")  # otherwise it is the time of writing, and equal images would differ in bytes
    data = _encode(path, ".exr", spec, parts, metadata)
    if not is_whole_exr(data, height):
        raise _cut_short(path)
    return data


def encode_png(path: Path, pixels: np.ndarray[Any, np.dtype[np.uint8]], metadata: Mapping[str, Value]) -> bytes:
    """Encode a PNG of 8 bits, tagged as sRGB.

    Args:
        path: where it will lie, for messages.
        pixels: (H, W, C).
        metadata: name -> value; entries on a scene's colours are left out.

    Raises:
        InputError: memory or the limit on the size of files does not suffice.
    """
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "uint8")
    spec.attribute("oiio:ColorSpace", "srgb_rec709_scene")
    for name, value in _PNG.items():
        spec.attribute(name, value)
    data = _encode(path, ".png", spec, (pixels,), {name: value for name, value in metadata.items() if name not in _OF_A_SCENE})
    if not whole_png(io.BytesIO(data[8:])):
        raise _cut_short(path)
    return data


def _is_half(pixels: Array) -> bool:
    """Whether no value exceeds half's range."""
    # By largest and smallest value: np.abs would copy them, and a maximum along two axes is ten times as slow.
    return bool(max(pixels.max(), -pixels.min()) <= HALF_MAX)


def require_finite(path: Path, names: tuple[str, ...], pixels: Array) -> None:
    """Raise ValueError if a value of (H, W, C) is not finite; name the first."""
    if np.isfinite(pixels).all():
        return
    for i, name in enumerate(names):
        bad = ~np.isfinite(pixels[..., i])
        if bad.any():
            y, x = np.argwhere(bad)[0]
            raise ValueError(f"{path}: channel {name}: {int(bad.sum())} non-finite values, first at (y={y}, x={x})")


def _encode(path: Path, suffix: str, spec: oiio.ImageSpec, parts: Sequence[Pixels], metadata: Mapping[str, Value]) -> bytes:
    def write(output: oiio.ImageOutput, row: int) -> bool:
        rows = slice(row, min(row + _LINES, spec.height))
        pixels = np.concatenate([part[rows] for part in parts], axis=-1)
        return output.write_scanlines(spec.y + rows.start, spec.y + rows.stop, 0, pixels)

    for name, value in metadata.items():
        if isinstance(value, tuple):
            spec.attribute(name, oiio.TypeDesc(_TYPES.get(name, f"float[{len(value)}]")), value)
        else:
            spec.attribute(name, value)
    with _memory(suffix) as place:
        output = oiio.ImageOutput.create(f"image{suffix}")
        if output is None:
            raise InputError(f"{path}: cannot be written: {last_error(oiio)}")
        ok = output.open(place, spec) and all(write(output, row) for row in range(0, spec.height, _LINES))
        error = last_error(output)
        if not (output.close() and ok):
            raise InputError(f"{path}: cannot be written: {error or last_error(output) or 'no reason given'}")
        return Path(place).read_bytes()


@contextmanager
def _memory(suffix: str) -> Generator[str, None, None]:
    """The name of a file in memory, or of a temporary file where the system has no files in memory."""
    try:
        handle = os.memfd_create("stss")
    except (AttributeError, OSError):
        handle = None
    place = Path(f"/proc/self/fd/{handle}")
    try:
        if handle is not None and place.exists():
            yield str(place)
        else:
            with tempfile.TemporaryDirectory(prefix="stss-") as folder:
                yield str(Path(folder) / f"image{suffix}")
    finally:
        if handle is not None:
            os.close(handle)


def is_whole_exr(data: bytes, height: int) -> bool:
    """Whether the table of chunks leads from chunk to chunk up to the last byte of the file."""
    try:
        at = 8  # behind magic number and version
        while data[at]:  # an attribute: name, type, size, value
            at = data.index(b"\0", data.index(b"\0", at) + 1) + 1
            at += 4 + struct.unpack_from("<i", data, at)[0]
        chunks = -(-height // _CHUNK_LINES)
        table = struct.unpack_from(f"<{chunks}Q", data, at + 1)
        at += 1 + 8 * chunks
        for place in table:
            if place != at:
                return False
            at += 8 + struct.unpack_from("<i", data, at + 4)[0]
    except (IndexError, ValueError, struct.error):
        return False
    return at == len(data)


def _cut_short(path: Path) -> InputError:
    return InputError(f"{path}: cannot be written: cut short by a limit on memory or on the size of files")
