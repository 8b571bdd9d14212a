# SPDX-License-Identifier: MIT
"""Headers of EXR and PNG files, checked before memory is taken.

A file is refused, with one line, when it is larger than `MAX_SIDE`, `MAX_CHANNELS` or `MAX_BYTES` allow, or when all of
it is deep; deep parts beside flat ones are passed over. OpenImageIO gets the same limits, so that its own header code
keeps to them too. A file is as large as its display window, whatever part of it its data windows cover.
"""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import OpenImageIO as oiio  # noqa: N813

from stss.images.exr_header import MOST_HEADER, ends_early, header_bytes
from stss.images.windows import PixelWindow
from stss_ground.errors import InputError
from stss_ground.regular_file import require_regular

DWA_LEVEL = 45.0
"""OpenEXR's own level of DWA, of files that name none."""
MAX_SIDE = 16384
MAX_CHANNELS = 1024
MAX_BYTES = 4 << 30
MAX_FILE_BYTES = 4 << 30
MAX_PARTS = 256

_BLOCK = 1 << 20
_FORMATS = {"uint": "uint32"}
"""OpenImageIO's name of a format -> the usual one."""
_BEAUTY_WORDS = {"rgb", "rgba", "beauty", "combined"}
_BEAUTY_NAMES = {"c", "ci", "color", "colour", "image", "main"}
"""Renderers' names for the part of the picture, as a word of its name or as all of it; Houdini writes ``N``, ``albedo`` and ``C``."""
_MAGIC = {".exr": b"\x76\x2f\x31\x01", ".png": b"\x89PNG\r\n\x1a\n"}
_KINDS = {"an EXR": _MAGIC[".exr"], "a PNG": _MAGIC[".png"], "a JPEG": b"\xff\xd8\xff", "a TIFF": b"II*\0"}
"""Kinds of image as an error names them -> how such a file begins."""

oiio.attribute("limits:channels", MAX_CHANNELS)
oiio.attribute("limits:imagesize_MB", MAX_BYTES >> 20)
oiio.attribute("limits:resolution", MAX_SIDE)

Value = str | int | float | tuple[int | float, ...]


@dataclass(frozen=True)
class Header:
    """The header of an image file.

    Attributes:
        path: the file.
        display: its display window: the image.
        windows: name -> data window of the channel's part: the pixels in the file.
        channels: full names. A name that several parts of a multipart file use is ``PART.NAME``, except in the part `_plain_part`; those
            of a part with another view than the first part's begin with their view.
        formats: name -> "half", "float", "uint32", "uint8", "uint16".
        compression: name -> "zip", "dwaa:45", ... of the channel's part; "" where the format has no choice of it.
        attributes: metadata of all parts; where parts differ, the first part's value.
        views: a stereo file's, such as "left" and "right", the default one first.
        parts: name -> the name of the channel's part; "" where it has none.
    """

    path: Path
    display: PixelWindow
    windows: Mapping[str, PixelWindow]
    channels: tuple[str, ...]
    formats: Mapping[str, str]
    compression: Mapping[str, str]
    attributes: Mapping[str, Value]
    views: tuple[str, ...] = ()
    parts: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the display window."""
        return self.display.size

    def lossy(self, name: str) -> bool:
        """Whether the compression of a channel changes its values.

        PXR24 rounds 32-bit floats, B44 halves. DWA changes halves and floats whose names end as colours do, which a ``Y`` of a motion
        or a normal does too; other names go through zip.

        Source: OpenEXR, Technical Introduction, "Data Compression", and ``ImfDwaCompressor.cpp``, ``sDefaultChannelRules``.
        """
        kind, number_format = self.compression[name].split(":")[0], self.formats[name]
        if kind in ("dwaa", "dwab"):
            return number_format != "uint32" and name.rpartition(".")[2] in ("R", "G", "B", "Y", "RY", "BY")
        return (kind, number_format) in (("pxr24", "float"), ("b44", "half"), ("b44a", "half"))


def read_header(path: Path) -> Header:
    """Read and check a file's header; no pixel is read.

    Raises:
        InputError: the file is not there, not an EXR or PNG, broken, too large or deep.
    """
    with open_image(path) as image:
        return locate(path, image)[0]


@contextmanager
def open_image(path: Path) -> Generator[oiio.ImageInput, None, None]:
    """Open a file for reading and check its kind; pending errors are fetched, since OpenImageIO would print them."""
    magic = _MAGIC.get(path.suffix.lower())
    if magic is None:
        raise InputError(f"{path}: expected an .exr or .png file")
    stops = False
    try:
        # OpenImageIO takes names in UTF-8, whatever the locale: the text that Python made of one may have other bytes.
        name = os.fsencode(path).decode()
        if (size := require_regular(path)) > MAX_FILE_BYTES:
            raise InputError(f"{path}: expected a file of at most {MAX_FILE_BYTES >> 20} MiB")
        with path.open("rb") as file:
            if (start := file.read(8))[: len(magic)] != magic:
                raise InputError(f"{path}: expected {_kind_of(magic)}, found {_kind_of(start)}")
            file.seek(len(magic))
            if path.suffix.lower() == ".exr":
                if (length := header_bytes(file)) > MOST_HEADER:
                    raise InputError(f"{path}: a header of more than {MOST_HEADER >> 20} MiB")
                if length >= size:
                    raise InputError(f"{path}: truncated or corrupt: its header goes on behind its {size} bytes")
                stops = ends_early(file, size)
            if path.suffix.lower() == ".png" and not whole_png(file):
                raise InputError(f"{path}: truncated or corrupt")
    except UnicodeError:
        raise InputError(f"{path}: expected a name in UTF-8") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    image = oiio.ImageInput.open(name, config)
    if image is None:
        raise InputError(f"{path}: header cannot be read: {last_error(oiio)}")
    try:
        if stops:  # said of a sound header alone, since a damaged one does not tell where pixels lie
            raise InputError(f"{path}: truncated or corrupt: pixels are missing behind its {size} bytes")
        yield image
    finally:
        image.close()
        last_error(image)  # a pending message would be printed when the object goes


def _kind_of(start: bytes) -> str:
    """The kind of a file that begins so, as an error names it."""
    return next(
        (kind for kind, magic in _KINDS.items() if start.startswith(magic)), "another kind of file" if start else "0 bytes"
    )


def whole_png(file: BinaryIO) -> bool:
    """Whether every chunk up to the last is there with its checksum; libpng would report a fault on standard error only."""
    while len(head := file.read(8)) == 8:
        length, kind = int.from_bytes(head[:4], "big"), head[4:]
        checksum = zlib.crc32(kind)
        while length and (data := file.read(min(length, _BLOCK))):
            checksum, length = zlib.crc32(data, checksum), length - len(data)
        if length or file.read(4) != checksum.to_bytes(4, "big"):
            return False
        if kind == b"IEND":
            return True
    return False


def locate(path: Path, image: oiio.ImageInput) -> tuple[Header, dict[str, tuple[int, int]]]:
    """The header of all parts, and where each channel lies: name -> (part, index)."""
    display = _display(image.spec())
    parts, attributes, views = _read_parts(path, image, display)
    places: dict[str, tuple[int, int]] = {}
    formats: dict[str, str] = {}
    windows: dict[str, PixelWindow] = {}
    compression: dict[str, str] = {}
    part_names: dict[str, str] = {}
    holders: dict[tuple[str, str], list[int]] = {}
    for number, each in enumerate(parts):
        for name in each.channels:
            holders.setdefault((each.view, name), []).append(number)
    plain = {key: _plain_part(parts, numbers) for key, numbers in holders.items()}
    for number, each in enumerate(parts):
        for index, name in enumerate(each.channels):
            full = name if plain[each.view, name] == number else f"{each.name}.{name}"
            if each.view not in ("", parts[0].view):
                full = f"{each.view}.{full}"
            if full in places:
                raise InputError(f"{path}: channel {full} appears twice")
            places[full] = number, index
            formats[full], windows[full], compression[full] = each.formats[index], each.data, each.compression
            part_names[full] = each.name
    header = Header(path, display, windows, tuple(places), formats, compression, attributes, views, part_names)
    return header, places


def _read_parts(
    path: Path, image: oiio.ImageInput, display: PixelWindow
) -> tuple[list[_Part], dict[str, Value], tuple[str, ...]]:
    """The headers of all parts, their metadata as one, and their views; a file that is too large is refused on the way."""
    attributes: dict[str, Value] = {}
    views: dict[str, None] = {}
    part, size = 0, 0
    parts: list[_Part] = []
    while image.seek_subimage(part, 0):
        spec = image.spec()
        _check(path, spec, display)
        data = _data(spec)
        # For both windows: pixels are decoded in the first, and placed in the second.
        size += int(spec.pixel_bytes(True)) * max(data.width * data.height, display.width * display.height)
        own, names = _attributes(spec), () if spec.deep else _names(path, spec)
        parts.append(
            _Part(
                spec.get_string_attribute("oiio:subimagename"),
                str(own.get("view", "")),
                names,
                tuple(_FORMATS.get(kind := str(spec.channelformat(i)), kind) for i in range(len(names))),
                _compression(spec),
                data,
            )
        )
        views |= dict.fromkeys(_words(own.get("multiView")) or _words(own.get("view")))
        attributes = own | attributes
        part, count = part + 1, sum(len(p.channels) for p in parts)
        if part > MAX_PARTS or count > MAX_CHANNELS or size > MAX_BYTES:
            limits = f"{MAX_PARTS}, {MAX_CHANNELS} and {MAX_BYTES}"
            raise InputError(f"{path}: {part} parts, {count} channels, {size} bytes; at most {limits}")
    if not any(each.channels for each in parts):
        raise InputError(f"{path}: deep image; expected flat channels")
    last_error(image)
    return parts, attributes, tuple(views)


class _Part(NamedTuple):
    """The header of a part of a file: its name, its view, its channels with their formats, its compression, its data window."""

    name: str
    view: str
    channels: tuple[str, ...]
    formats: tuple[str, ...]
    compression: str
    data: PixelWindow


def _plain_part(parts: Sequence[_Part], holders: Sequence[int]) -> int | None:
    """The part that keeps the plain name of a channel which several parts of a view have: the picture's part.

    None where no name says which part that is: a guess by their order would take normals for colours.
    """
    if len(holders) > 1:
        names = {n: parts[n].name.lower() for n in holders}
        holders = [n for n in holders if names[n] in _BEAUTY_NAMES or _BEAUTY_WORDS & {*re.split(r"[\W_]+", names[n])}]
    return holders[0] if holders else None


def _compression(spec: oiio.ImageSpec) -> str:
    kind = spec.get_string_attribute("compression")
    return f"{kind}:{spec.get_float_attribute('openexr:dwaCompressionLevel', DWA_LEVEL):g}" if kind.startswith("dwa") else kind


def _data(spec: oiio.ImageSpec) -> PixelWindow:
    return PixelWindow(spec.x, spec.y, spec.width, spec.height)


def _display(spec: oiio.ImageSpec) -> PixelWindow:
    return PixelWindow(spec.full_x, spec.full_y, spec.full_width, spec.full_height)


def _check(path: Path, spec: oiio.ImageSpec, display: PixelWindow) -> None:
    sides = spec.width, spec.height, spec.full_width, spec.full_height
    if not (all(1 <= side <= MAX_SIDE for side in sides) and 1 <= spec.nchannels <= MAX_CHANNELS):
        size = f"{spec.width} x {spec.height}, {spec.nchannels} channels"
        if sides[2:] != sides[:2]:
            size += f", display window {_display(spec)}"
        raise InputError(f"{path}: {size}; expected 1 to {MAX_SIDE} pixels a side, 1 to {MAX_CHANNELS} channels")
    if spec.depth != 1 or spec.full_depth != 1:
        raise InputError(f"{path}: volume; expected a flat image")
    if _display(spec) != display:
        raise InputError(f"{path}: parts with different display windows: {display}, {_display(spec)}")


def _names(path: Path, spec: oiio.ImageSpec) -> tuple[str, ...]:
    try:
        return tuple(spec.channelnames)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: a channel name is not UTF-8") from error


def _attributes(spec: oiio.ImageSpec) -> dict[str, Value]:
    values: dict[str, Value] = {}
    for i in range(len(spec.extra_attribs)):
        try:
            item = spec.extra_attribs[i]
            name, value = item.name, item.value
        except UnicodeDecodeError:
            continue
        if isinstance(value, str | int | float):
            values[name] = value
        elif isinstance(value, tuple | list | np.ndarray):  # pyrefly: ignore[implicit-any-type-argument]
            values[name] = tuple(x.item() if isinstance(x, np.generic) else x for x in np.ravel(value))
    return values


def _words(value: Any) -> tuple[str, ...]:
    """The words of an attribute that is text, or several of it."""
    return tuple(str(word) for word in (value if isinstance(value, tuple) else (value,)) if word)


def last_error(source: Any) -> str:
    """The pending message of OpenImageIO, on one line; asking for it keeps it from being printed."""
    try:
        return " ".join(str(source.geterror()).split())[:300]
    except UnicodeDecodeError:
        return "corrupt"
