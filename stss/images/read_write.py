# SPDX-License-Identifier: MIT
"""EXR and PNG pixels through OpenImageIO: read whole or not at all, written beside and renamed into place."""

from __future__ import annotations

import os
import secrets
from collections.abc import Collection, Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio  # noqa: N813

from stss.errors import InputError
from stss.images.headers import Header, last_error, locate, opened, read_header
from stss_ref.arrays import Array, Image, Mask, Plane

__all__ = ["Header", "placed", "read_channels", "read_header", "read_rgb", "write_channels", "write_mask", "write_rgb"]

HALF_MAX = 65504.0

_GAP = 4
"""So many unwanted channels are read along, rather than decompressing the file once more."""


def read_channels(path: Path, names: Sequence[str]) -> dict[str, Plane]:
    """Read channels by their full names.

    Returns:
        Name -> (H, W) float32. Whole numbers of an EXR keep their value; those of a PNG come as 0..1.

    Raises:
        InputError: as `read_header`; a channel is not there; or a pixel of the file cannot be decoded.
    """
    with opened(path) as image:
        header, places = locate(path, image)
        for name in names:
            if name not in places:
                raise InputError(f"{path}: no channel {name}; it has {', '.join(header.channels)}")
        planes: dict[str, Plane] = {}
        for part, first, stop, integer in _runs({places[n] + (header.formats[n] == "uint32",) for n in names}):
            pixels = image.read_image(part, 0, first, stop, "uint" if integer else "float")
            error = last_error(image)
            if pixels is None or error or pixels.shape[:2] != header.size:
                raise InputError(f"{path}: truncated or corrupt: {error or 'pixels cannot be decoded'}")
            for name in names:
                if places[name][0] == part and first <= places[name][1] < stop:
                    planes[name] = _quiet(np.ascontiguousarray(pixels[..., places[name][1] - first], dtype=np.float32))
    return {name: planes[name] for name in names}


def _quiet(plane: Plane) -> Plane:
    """Without signalling NaN, in place: NumPy warns where one is cast."""
    nan = np.isnan(plane)
    if nan.any():
        plane[nan] = np.nan
    return plane


def read_rgb(path: Path) -> Image:
    """Read a colour image.

    Returns:
        (H, W, 3) float32; an EXR's values as stored, a PNG's display values in 0..1. Of an EXR without R, G, B the
        layer ``Combined``, or else the only one that has R, G, B.

    Raises:
        InputError: as `read_channels`; or there is no such layer, or more than one.
    """
    channels = read_header(path).channels
    if "R" not in channels and path.suffix.lower() == ".png":
        names = (channels[0],) * 3
    else:
        layers = [name[:-1] for name in channels if name[-1] == "R" and {name[:-1] + "G", name[:-1] + "B"} <= {*channels}]
        layers = [x for x in layers if not x] or [x for x in layers if x.endswith(("Combined.", "RGBA."))] or layers
        if len(layers) != 1:
            raise InputError(f"{path}: expected channels R, G, B or one layer with them; it has {', '.join(channels)}")
        names = tuple(layers[0] + letter for letter in "RGB")
    planes = read_channels(path, names)
    return np.stack([planes[name] for name in names], axis=-1)


def write_channels(
    path: Path,
    channels: Mapping[str, Plane],
    *,
    half: Collection[str] = (),
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write an EXR (zip); channels are float, those in ``half`` are half unless a value exceeds half's range.

    Raises:
        ValueError: a value is not finite, or a channel does not have the size of the others.
    """
    pixels = np.stack([np.asarray(plane, dtype=np.float32) for plane in channels.values()], axis=-1)
    _write_exr(path, tuple(channels), pixels, half, metadata or {})


def write_rgb(path: Path, image: Image, *, metadata: Mapping[str, str] | None = None) -> None:
    """Write a colour image by its suffix.

    Args:
        path: .exr: scene-linear, half, zip. .png: 8 bits, rounded to nearest, clipped to 0..1.
        image: (H, W, 3); scene-linear for EXR, display-referred for PNG.
        metadata: name -> text; `read_header` finds it again.

    Raises:
        InputError: another suffix.
        ValueError: a value is not finite.
    """
    if path.suffix.lower() == ".exr":
        _write_exr(path, tuple("RGB"), np.ascontiguousarray(image, dtype=np.float32), "RGB", metadata or {})
    elif path.suffix.lower() == ".png":
        _require_finite(path, tuple("RGB"), image)
        pixels = np.rint(np.clip(image.astype(np.float64), 0, 1) * 255).astype(np.uint8)
        _write_png(path, np.ascontiguousarray(pixels), metadata or {})
    else:
        raise InputError(f"{path}: expected a name ending in .exr or .png")


def write_mask(path: Path, mask: Mask) -> None:
    """Write a mask as an 8-bit grey PNG: 255 = True."""
    _write_png(path, np.where(mask, 255, 0).astype(np.uint8)[..., None], {})


@contextmanager
def placed(path: Path) -> Generator[Path, None, None]:
    """A temporary path beside ``path`` to write to; renamed into place, or removed when the block fails."""
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(6)}{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _runs(wanted: set[tuple[int, int, bool]]) -> list[tuple[int, int, int, bool]]:
    """Join channels (part, index, integer) to stretches (part, first, stop, integer) that are read in one go."""
    runs: list[tuple[int, int, int, bool]] = []
    for part, index, integer in sorted(wanted, key=lambda x: (x[0], x[2], x[1])):
        if runs and runs[-1][0] == part and runs[-1][3] == integer and index - runs[-1][2] <= _GAP:
            runs[-1] = part, runs[-1][1], index + 1, integer
        else:
            runs.append((part, index, index + 1, integer))
    return runs


def _require_finite(path: Path, names: Sequence[str], pixels: Array) -> None:
    if np.isfinite(pixels).all():
        return
    for i, name in enumerate(names):
        bad = ~np.isfinite(pixels[..., i])
        if bad.any():
            y, x = np.argwhere(bad)[0]
            raise ValueError(f"{path}: channel {name}: {int(bad.sum())} non-finite values, first at (y={y}, x={x})")


def _write_exr(path: Path, names: tuple[str, ...], pixels: Array, half: Collection[str], metadata: Mapping[str, str]) -> None:
    _require_finite(path, names, pixels)
    # Largest and least: np.abs would copy all of it, and a maximum along two axes is ten times as slow.
    fits = [max(pixels[..., i].max(), -pixels[..., i].min()) <= HALF_MAX for i in range(len(names))]
    formats = ["half" if name in half and small else "float" for name, small in zip(names, fits, strict=True)]
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], len(names), formats[0])
    spec.channelnames = names
    if len({*formats}) > 1:  # OpenImageIO ignores formats that are all the same
        spec.channelformats = tuple(oiio.TypeDesc(name) for name in formats)
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "")  # else the time of writing: the same picture would have other bytes
    _write(path, spec, pixels, metadata)


def _write_png(path: Path, pixels: np.ndarray[Any, np.dtype[np.uint8]], metadata: Mapping[str, str]) -> None:
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "uint8")
    spec.attribute("oiio:ColorSpace", "srgb_rec709_scene")
    _write(path, spec, pixels, metadata)


def _write(path: Path, spec: oiio.ImageSpec, pixels: Array | np.ndarray[Any, Any], metadata: Mapping[str, str]) -> None:
    for name, text in metadata.items():
        spec.attribute(name, text)
    with placed(path) as temporary:
        output = oiio.ImageOutput.create(str(temporary))
        if output is None:
            raise InputError(f"{path}: cannot be written: {last_error(oiio)}")
        done = output.open(str(temporary), spec) and output.write_image(pixels)
        error = last_error(output)
        if not (output.close() and done):
            raise InputError(f"{path}: cannot be written: {error or last_error(output) or 'no reason given'}")
