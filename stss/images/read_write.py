# SPDX-License-Identifier: MIT
"""Read and write the pixels of EXR and PNG files through OpenImageIO, whole or not at all."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenImageIO as oiio  # noqa: N813

from stss.images.color import BLOCK
from stss.images.encode import encode_exr, encode_png, require_finite
from stss.images.headers import Header, Value, last_error, locate, open_image, read_header
from stss.images.windows import PixelWindow
from stss_ground.arguments import listing, suggest
from stss_ground.cores import for_blocks
from stss_ground.errors import InputError
from stss_ground.output.write_whole import write_whole
from stss_ref.arrays import Array, Image, Mask, Plane

__all__ = ["Header", "read_channels", "read_header", "read_rgb", "write_channels", "write_mask", "write_rgb"]

WHOLE = 1 << 24
"""A 32-bit float holds every whole number up to this one."""
_READ_AS = {"uint32": "uint", "uint16": "uint16"}
"""Formats of whole numbers -> the kind of number to read them as; all others are read as floats."""
_GAP = 4
"""Most unwanted channels between wanted ones that are read with them: a second read would decompress the file again."""
_LINES = {"piz": 32, "b44": 32, "b44a": 32, "dwaa": 32, "htj2k32": 32, "dwab": 256, "htj2k256": 256}
_USUAL_LINES = 16
"""Lines to read at once, by compression: one chunk of it, so that all channels of them stay in the processor's cache."""


def read_channels(path: Path, names: Sequence[str], window: PixelWindow | None = None) -> dict[str, Plane]:
    """Read channels by their full names.

    Args:
        path: the file.
        names: of the channels.
        window: the pixels to return, 0 where a channel has none; None: the display window.

    Returns:
        Name -> (H, W) float32. Whole numbers of an EXR keep their value; those of a PNG come as 0..1.

    Raises:
        InputError: as `read_header`; a channel is not there; or a pixel of the file cannot be decoded.
    """
    with open_image(path) as image:
        places = locate(path, image)
        window = window or places[0].display
        planes = {name: np.zeros(window.size, np.float32) for name in names}
        _read_planes(image, *places, [*planes.items()], window)
    return planes


def read_planes(path: Path, planes: Sequence[tuple[str, Plane]], window: PixelWindow) -> None:
    """Read channels, by their full names, into planes (H, W) float32 of ``window``; pixels that a channel has not stay as they are.

    Raises:
        InputError: as `read_channels`.
    """
    with open_image(path) as image:
        _read_planes(image, *locate(path, image), planes, window)


def _read_planes(
    image: oiio.ImageInput,
    header: Header,
    places: Mapping[str, tuple[int, int]],
    planes: Sequence[tuple[str, Plane]],
    window: PixelWindow,
) -> None:
    path = header.path
    for name, _ in planes:
        if name not in places:
            raise InputError(f"{path}: no channel {name}; it has {listing(header.channels)}{suggest(name, header.channels)}")
    for run in _runs({(*places[name], _READ_AS.get(header.formats[name], "float")) for name, _ in planes}):
        to = [(name, places[name][1] - run.first, plane) for name, plane in planes if run.has(places[name])]
        like = next(name for name in header.channels if places[name][0] == run.part)
        # A PNG has to be read in order, and OpenImageIO reads tiles whole.
        by_lines = path.suffix.lower() == ".exr" and not image.spec(run.part, 0).tile_width
        lines = _LINES.get(header.compression[like].split(":")[0], _USUAL_LINES) if by_lines else header.windows[like].height
        _read_run(image, path, run, lines, header.windows[like], to, window)


class _Run(NamedTuple):
    """Neighbouring channels of a part, from ``first`` up to ``stop``, that are read at once, as one kind of number."""

    part: int
    first: int
    stop: int
    kind: str

    def has(self, place: tuple[int, int]) -> bool:
        """Whether a channel, by its part and its index there, is read with them."""
        return place[0] == self.part and self.first <= place[1] < self.stop


def _read_run(
    image: oiio.ImageInput,
    path: Path,
    run: _Run,
    lines: int,
    data: PixelWindow,
    to: Sequence[tuple[str, int, Plane]],
    window: PixelWindow,
) -> None:
    """Read a run of channels of the data window ``data``, ``lines`` at a time.

    ``to``: channels of it, each with its place in the run and the plane of ``window`` to fill.
    """
    part, first, stop, kind = run

    def read(rows: slice) -> None:
        block = PixelWindow(data.x, data.y + rows.start, data.width, rows.stop - rows.start)
        if lines < data.height:
            pixels = image.read_scanlines(part, 0, block.y, block.y + block.height, 0, first, stop, kind)
        else:
            pixels = image.read_image(part, 0, first, stop, kind)
        error = last_error(image)
        if pixels is None or error or pixels.shape[:2] != block.size:
            raise InputError(f"{path}: truncated or corrupt: {error or 'pixels cannot be decoded'}")
        if kind == "float":
            make_quiet(pixels)
        there, here = block.within(window), window.within(block)
        for name, i, plane in to:
            values = pixels[..., i][here]
            if kind == "uint16":  # OpenImageIO multiplies: some levels come a little low
                values = values / 65535
            plane[there] = values
            if kind == "uint" and (bad := merge(values, plane[there], there)) is not None:
                raise InputError(f"{path}: channel {name}: {bad}")

    for_blocks(data.height, lines, read)


def merge(values: Array, plane: Plane, place: tuple[slice, slice]) -> str | None:
    """The fault where whole numbers (H, W) do not fit into 32-bit floats: two objects would have one number.

    ``plane``: the same as floats, which are this ``place`` of an image.
    """
    if not values.size or values.max() <= WHOLE:
        return None
    bad = (values > WHOLE) & (plane.astype(np.float64) != values)
    if not bad.any():
        return None
    y, x = np.argwhere(bad)[0]
    where = f"(y={place[0].start + y}, x={place[1].start + x})"
    return f"expected whole numbers up to {WHOLE}, beyond which 32-bit floats merge them; found {values[y, x]} at {where}"


def make_quiet(pixels: Array) -> None:
    """Turn signalling NaN into quiet ones, in place: NumPy warns when it casts a signalling one."""
    nan = np.isnan(pixels)
    if nan.any():
        pixels[nan] = np.nan


def read_rgb(path: Path) -> Image:
    """Read a colour image.

    Returns:
        (H, W, 3) float32; an EXR's values as stored, a PNG's display values in 0..1. An EXR without R, G, B is read from its
        layer ``Combined``, or else from the only layer that has R, G, B; without any, from r, g, b in the same way.

    Raises:
        InputError: as `read_channels`; or there is no such layer, or more than one.
    """
    channels = read_header(path).channels
    if "R" not in channels and path.suffix.lower() == ".png":
        names = (channels[0],) * 3
    else:
        # Lower case last: matte layers have it beside the picture, as Cryptomatte does.
        layers = _layers_with(channels, "RGB") or _layers_with(channels, "rgb")
        layers = (
            [x for x in layers if len(x[0]) == 1] or [x for x in layers if x[0][:-1].endswith(("Combined.", "RGBA."))] or layers
        )
        if len(layers) != 1:
            raise InputError(f"{path}: expected channels R, G, B or one layer with them; it has {listing(channels)}")
        names = layers[0]
    planes = read_channels(path, names)
    return np.stack([planes[name] for name in names], axis=-1)


def _layers_with(channels: Sequence[str], letters: str) -> list[tuple[str, ...]]:
    """The channels of each layer that has all of these letters."""
    layers = [tuple(name[:-1] + letter for letter in letters) for name in channels if name[-1] == letters[0]]
    return [layer for layer in layers if {*layer} <= {*channels}]


def write_channels(
    path: Path,
    channels: Mapping[str, Plane],
    *,
    half: Collection[str] = (),
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write an EXR: `encode_channels`, whole or not at all.

    Raises:
        InputError: it can't be written.
        ValueError: as `encode_channels`.
    """
    write_whole(path, encode_channels(path, channels, half=half, metadata=metadata))


def write_rgb(path: Path, image: Image, *, metadata: Mapping[str, str] | None = None) -> None:
    """Write a colour image: `encode_rgb`, whole or not at all.

    Raises:
        InputError: as `encode_rgb`; or it can't be written.
        ValueError: a value is not finite.
    """
    write_whole(path, encode_rgb(path, image, metadata=metadata))


def write_mask(path: Path, mask: Mask) -> None:
    """Write a mask: `encode_mask`, whole or not at all."""
    write_whole(path, encode_mask(path, mask))


def encode_channels(
    path: Path,
    channels: Mapping[str, Plane],
    *,
    half: Collection[str] = (),
    metadata: Mapping[str, str] | None = None,
) -> bytes:
    """Encode an EXR (zip); channels are float, those in ``half`` are half unless a value exceeds half's range.

    Raises:
        ValueError: a value is not finite, or a channel does not have the size of the others.
    """
    pixels = np.stack([np.asarray(plane, dtype=np.float32) for plane in channels.values()], axis=-1)
    return encode_exr(path, tuple(channels), pixels, half, metadata or {})


def encode_rgb(
    path: Path,
    image: Image,
    *,
    metadata: Mapping[str, Value] | None = None,
    more: Mapping[str, Plane] | None = None,
    windows: tuple[PixelWindow, PixelWindow] | None = None,
) -> bytes:
    """Encode a colour image in the format of its file's suffix.

    Args:
        path: where it will lie. .exr: scene-linear, half, zip. .png: 8 bits, rounded to nearest, clipped to 0..1.
        image: (H, W, 3); scene-linear for EXR, display-referred for PNG.
        metadata: name -> value; `read_header` finds it again.
        more: further channels (H, W) of an EXR.
        windows: data window, of the image's size, and display window of an EXR; None: both begin at 0.

    Raises:
        InputError: the suffix is neither of these.
        ValueError: a value is not finite.
    """
    if path.suffix.lower() == ".exr":
        names = (*"RGB", *(more or {}))
        planes = (image, *(plane[..., None] for plane in (more or {}).values()))
        parts = [np.asarray(plane, np.float32) for plane in planes]
        return encode_exr(path, names, parts, names, metadata or {}, windows)
    if path.suffix.lower() == ".png":
        require_finite(path, tuple("RGB"), image)
        pixels = np.empty(image.shape, np.uint8)

        def round_rows(rows: slice) -> None:
            pixels[rows] = np.rint(np.clip(image[rows].astype(np.float64), 0, 1) * 255)

        for_blocks(len(pixels), max(1, BLOCK // image.shape[1]), round_rows)
        return encode_png(path, pixels, metadata or {})
    raise InputError(f"{path}: expected a name ending in .exr or .png")


def encode_mask(path: Path, mask: Mask) -> bytes:
    """Encode a mask (H, W) as an 8-bit grey PNG: 255 = True."""
    return encode_png(path, np.where(mask, 255, 0).astype(np.uint8)[..., None], {})


def _runs(channels: set[tuple[int, int, str]]) -> list[_Run]:
    """Join channels (part, index, kind of number) into runs."""
    runs: list[_Run] = []
    for part, index, kind in sorted(channels, key=lambda x: (x[0], x[2], x[1])):
        if runs and runs[-1].part == part and runs[-1].kind == kind and index - runs[-1].stop <= _GAP:
            runs[-1] = runs[-1]._replace(stop=index + 1)
        else:
            runs.append(_Run(part, index, index + 1, kind))
    return runs
