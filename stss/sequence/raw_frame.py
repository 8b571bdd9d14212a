# SPDX-License-Identifier: MIT
"""Read the buffers of a frame as they are stored, and refuse or mask values that are not finite."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from stss.images.headers import Value, read_header
from stss.images.read_write import read_planes
from stss.images.windows import PixelWindow
from stss.sequence.camera import CameraPose
from stss.sequence.channels import Source
from stss_ground.arguments import listing, suggest
from stss_ground.errors import InputError
from stss_ref.arrays import Array

NonFinite = Literal["refuse", "mask"]

UNIT_RANGE = ("base_color", "roughness", "metallic")
"""Buffers that are clipped to [0, 1]."""
FINITE = ("color", "normal", "stencil", "nov", *UNIT_RANGE)
"""Buffers that must be finite. In motion, depth and position a non-finite value has a meaning: off screen, nothing hit, a hole."""

OF_COLOR = ("adoptedNeutral", "chromaticities", "oiio:ColorSpace", "whiteLuminance")
"""Metadata that say what the numbers of a colour mean; a G-buffer's files may lack them, or have others."""
CARRIED = (
    "framesPerSecond",
    "FramesPerSecond",
    "PixelAspectRatio",
    "smpte:TimeCode",
    "worldToCamera",
    "worldToNDC",
    *OF_COLOR,
)
"""Metadata that outputs copy from the frame's files, by OpenImageIO's names. OpenEXR's rate has a small f, that of some writers a
capital."""

NOTHING: Mapping[str, Source] = {}


@dataclass(frozen=True)
class RawFrame:
    """One display frame before it is read.

    Attributes:
        files: all files that belong to it.
        sources: buffer -> its place; without buffers that the files lack.
        camera: None where it is not known.
        attributes: metadata that compositors need, `CARRIED`.
        data: buffer -> data window of its part.
        fault: why its files cannot be read, or do not fit the others; None: they do.
    """

    files: tuple[Path, ...]
    sources: Mapping[str, Source]
    camera: CameraPose | None
    attributes: Mapping[str, Value] = field(default_factory=dict[str, Value])
    data: Mapping[str, PixelWindow] = field(default_factory=dict[str, PixelWindow])
    fault: InputError | None = None


def find_carried(where: str, frame: RawFrame, also: Collection[str]) -> dict[str, Source]:
    """Find the planes that do not go through the network: alpha beside the colour, and the layers and channels in ``also``.

    Args:
        where: the frame, for errors.
        frame: the frame; one without a colour has none.
        also: names of layers or channels.

    Raises:
        InputError: there is no such layer or channel, or two planes would have one name.
    """
    if "color" not in frame.sources:
        return {}
    color, there = frame.sources["color"], {path: read_header(path).channels for path in frame.files}
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
            raise InputError(f"{where}: no layer or channel {name}; found {listing(names)}{near}")
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


def read_stored(
    frame: RawFrame,
    canvas: PixelWindow,
    constants: Mapping[str, float],
    also: Mapping[str, Source] = NOTHING,
    *,
    color: bool = True,
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Read the buffers as they are stored or filled with a constant, and the planes of ``also``, whose names may be those of buffers.

    Returns:
        Name -> (H, W, channels) float32 of both, 0 where a part has no pixels; without the colour where ``color`` is False.
    """
    buffers = {buffer: source for buffer, source in frame.sources.items() if color or buffer != "color"}
    arrays, carried = (
        {name: np.zeros((*canvas.size, len(source.names)), np.float32) for name, source in of.items()} for of in (buffers, also)
    )
    planes: dict[Path, list[tuple[str, Array]]] = {}
    for of, to in ((buffers, arrays), (also, carried)):
        for name, source in of.items():
            planes.setdefault(source.path, []).extend((full, to[name][..., i]) for i, full in enumerate(source.names))
    for path, of_file in planes.items():
        read_planes(path, of_file, canvas)
    for buffer, value in constants.items():
        if buffer not in arrays:
            arrays[buffer] = np.full((*canvas.size, 1), value, dtype=np.float32)
    return arrays, carried


def settle_non_finite(buffers: dict[str, Array], sources: Mapping[str, Source], policy: NonFinite) -> None:
    """Refuse values that are not finite where they must be, or replace them by 0, in place.

    A pixel whose colour is masked gets a position of NaN, so that later frames see a hole there.

    Raises:
        InputError: the policy is "refuse", and there is such a value.
    """
    color = buffers.get("color")
    settle_all_finite({buffer: buffers[buffer] for buffer in FINITE if buffer in buffers}, sources, policy, into=buffers)
    if color is not None and buffers["color"] is not color:
        hole = ~np.isfinite(color).all(axis=-1, keepdims=True)
        buffers["position"] = np.where(hole, np.float32(np.nan), buffers["position"])


def settle_all_finite(
    planes: Mapping[str, Array], sources: Mapping[str, Source], policy: NonFinite, *, into: dict[str, Array]
) -> None:
    """The same for planes that must be finite everywhere; changed planes are put ``into`` a dictionary."""
    for name, plane in planes.items():
        bad = ~np.isfinite(plane)
        if not bad.any():
            continue
        if policy == "refuse":
            channel = int(np.flatnonzero(bad.any(axis=(0, 1)))[0])
            y, x = np.argwhere(bad[..., channel])[0]
            where = f"{sources[name].path}: channel {sources[name].names[channel]}"
            count = int(bad[..., channel].sum())
            raise InputError(f"{where}: {count} non-finite values, first at (y={y}, x={x}); --non-finite mask takes them as 0")
        into[name] = np.where(bad, np.float32(0), plane)
