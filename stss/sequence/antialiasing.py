# SPDX-License-Identifier: MIT
"""Whether a sequence's frames are aliased or antialiased, judged by their pixels; this chooses the default weights."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stss.frames.buffers import Buffers
from stss.images.color import transfer
from stss.images.headers import Header, read_header
from stss.sequence.sequence import Sequence
from stss_ground.errors import InputError
from stss_ref.arrays import Array

LOOKED_AT = 3
"""Number of frames looked at, spread from the first rendered one to the last."""
NOT_UNIT = 0.01
"""A normal is a mixture when its length differs from 1 by more than this; half precision and interpolation stay below."""
MIXED_NORMALS = 0.02
"""Share of mixed normals from which frames count as antialiased. Found: up to 0.009 in aliased frames, also with bump maps and leaves;
0.066 and more in antialiased ones."""
DWA_LEVEL, DWA_NOT_UNIT, DWA_MIXED = 200.0, 0.05, 0.01
"""The same two where DWA changed the normals, up to this level (45 is usual). Found: up to 0.0023 in aliased frames, 0.030 and more in
antialiased ones."""
NOTHING = math.inf, math.inf
"""The same two for normals that allow no judgement."""
MIXED_COLORS = 0.47
"""Share of edges with a colour in between from which frames count as antialiased. Found: up to 0.34 in aliased frames, by their
textures; 0.59 and more in antialiased ones."""
MIN_EDGES = 50
"""Fewest edges that allow a judgement."""
SAME, STEP = 0.05, 0.3
"""Normals of one surface differ by less than `SAME` in each component, those of two surfaces by more than `STEP` in one."""
CONTRAST = 0.15
"""Edges of less contrast, display-referred, do not count."""
BETWEEN = 0.15, 0.85
"""A colour is in between when its share of the way from one side's colour to the other's lies in this range."""


@dataclass(frozen=True)
class Sampling:
    """How the pixels were sampled, and the reason for that verdict.

    Attributes:
        antialiased: colour, or colour and G-buffer, are means over the pixel.
        reason: for the user.
    """

    antialiased: bool
    reason: str


def judge_sampling(sequence: Sequence) -> Sampling:
    """Look at a few rendered frames. A frame that cannot be read does not count here; the step that needs it reports it.

    An antialiased G-buffer has normals that are not of unit length along every silhouette. If the G-buffer is aliased, the colour
    decides: where the surface's normal jumps from one pixel to the next, an aliased colour jumps as well, and an antialiased one
    has a pixel in between. If neither decides, frames count as aliased, since engines give such frames. Normals that B44 or a strong DWA
    changed do not count; PXR24 changes no length noticeably.
    """
    rendered = sorted(sequence.rendered)
    numbers = sorted({rendered[i * (len(rendered) - 1) // (LOOKED_AT - 1)] for i in range(LOOKED_AT)}) if rendered else []
    linear = sequence.profile.color_domain == "linear"
    hit = mixed = edges = between = 0
    apart, share = NOT_UNIT, MIXED_NORMALS
    limits = {(apart, share)}
    for number in numbers:
        try:
            buffers = sequence.load(number, cut=True)  # motion says nothing here
        except InputError:
            continue
        source = sequence.frames[number].sources["normal"]
        limits |= {_limits(read_header(source.path), name) for name in source.names}
        apart, share = max(limits)
        # A sky may have a depth, of the far plane or of a dome, but it has no normal to be mixed.
        surface = np.isfinite(buffers.depth) & np.isfinite(buffers.normal).all(axis=-1) & (buffers.normal != 0).any(axis=-1)
        n = [buffers.normal[..., i][surface].astype(np.float64) for i in range(3)]
        length = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        hit, mixed = hit + length.size, mixed + int((np.abs(length - 1) > apart).sum())
        count, of = _colors_between(buffers, linear=linear)
        edges, between = edges + of, between + count
    if mixed > share * hit:
        return Sampling(True, f"{mixed / hit:.1%} of the normals are mixtures, not of unit length")
    if edges < MIN_EDGES:
        reason = "their compression changed the normals" if apart == math.inf else "normals are of unit length"
        return Sampling(False, f"{reason}, and only {edges} edges show whether colours are")
    reason = f"{between / edges:.0%} of the surfaces' edges have a colour in between"
    return Sampling(between > MIXED_COLORS * edges, reason)


def _limits(header: Header, name: str) -> tuple[float, float]:
    """The difference in length from which a normal is a mixture, and the share of mixtures from which frames are antialiased."""
    kind, _, level = header.compression[name].partition(":")
    if not header.lossy(name) or kind == "pxr24":
        return NOT_UNIT, MIXED_NORMALS
    return (DWA_NOT_UNIT, DWA_MIXED) if kind.startswith("dwa") and float(level) <= DWA_LEVEL else NOTHING


def _colors_between(buffers: Buffers, *, linear: bool) -> tuple[int, int]:
    """The number of edges with a colour in between, and of all edges with contrast; along rows and columns."""
    assert buffers.color is not None
    normal = np.nan_to_num(buffers.normal)
    rows = _between(buffers.color, normal, linear=linear)
    columns = _between(buffers.color.swapaxes(0, 1), normal.swapaxes(0, 1), linear=linear)
    return rows[0] + columns[0], rows[1] + columns[1]


def _between(color: Array, normal: Array, *, linear: bool) -> tuple[int, int]:
    """The same along rows. An edge is four pixels in a row, the first two of one surface and the last two of another."""
    # Component by component: NumPy is slow where the axis that lies together has three numbers.
    steps = [np.abs(np.diff(normal[..., i], axis=1)) for i in range(3)]
    jump = np.maximum(np.maximum(steps[0], steps[1]), steps[2])
    y, x = np.nonzero((jump[:, :-2] < SAME) & (jump[:, 1:-1] > STEP) & (jump[:, 2:] < SAME))
    if not len(y):
        return 0, 0
    encode = transfer("srgb" if linear else "none").encode
    start, *inner, stop = encode(np.stack([color[y, x + i] for i in range(4)])).astype(np.float64)
    way = stop - start
    square = (way * way).sum(axis=-1)
    edge = square > CONTRAST**2
    shares = [((part - start) * way).sum(axis=-1)[edge] / square[edge] for part in inner]
    low, high = BETWEEN
    has_between = np.any([(share > low) & (share < high) for share in shares], axis=0)
    return int(has_between.sum()), int(edge.sum())
