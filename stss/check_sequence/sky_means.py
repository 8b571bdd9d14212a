# SPDX-License-Identifier: MIT
"""Whether positions and depths along the background are means over a pixel's samples in which a miss counts as 0."""

from __future__ import annotations

import numpy as np

from stss.check_sequence.value_statistics import Line
from stss.frames.buffers import Buffers
from stss.sequence.background import static_surfaces
from stss.sequence.projection import Projection
from stss_ref.arrays import Mask

OFF = 1.0
"""Pixels: a position seen farther than this from its pixel belongs to no sample of the pixel."""
ON = 0.5
"""Pixels: the lengthened position is seen as near as this to its pixel."""
LIKE = 0.1
"""Largest difference of the lengthened depth from the distance of the lengthened position, as a share of it."""
MANY = 0.2
"""Share of the pixels beside the background from which on there is a warning."""
FEW = 30
"""Fewest pixels beside the background that allow a judgement."""


class SkyMeans:
    """Counts static pixels beside the background whose position and depth are parts of those of their surface.

    If a share ``c`` of a pixel's samples hit the surface, the pixel has the position ``c p`` and the depth ``c d``. No sample is seen at
    ``c p``, but ``s = 1 / c`` times it lies in the pixel. Positions that are wrong in another way do not return. Blender's depths are no
    means.
    """

    def __init__(self):
        self._means = self._beside = 0

    def add(self, frame: Buffers, projection: Projection) -> None:
        """Count those of a frame; its projection has three axes."""
        static = static_surfaces(frame)
        beside = static & _around(~np.isfinite(frame.depth))
        self._beside += int(beside.sum())
        self._means += int(_are_means(frame, projection, static, beside).sum())

    @property
    def share(self) -> float:
        """Of the pixels beside the background; 0 where too few are seen."""
        return self._means / self._beside if self._beside >= FEW else 0.0


def sky_lines(share: float) -> list[Line]:
    """Findings about `SkyMeans.share`."""
    text = f"position, depth: {share:.0%} of the pixels along the background have the mean of a surface and of 0"
    advice = "render them with one sample at each pixel's centre, apart from the colour (docs/profiles.md, mitsuba)"
    return [("warning", f"{text}: {advice}")] if share > MANY else []


def _around(mask: Mask) -> Mask:
    """The pixels beside those of a mask (H, W)."""
    padded = np.pad(mask, 1)
    return padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]


def _are_means(frame: Buffers, projection: Projection, static: Mask, beside: Mask) -> Mask:
    """(N,) of the N pixels ``beside``."""
    pixels, at = np.argwhere(beside)[:, ::-1], frame.position[beside].astype(np.float64)
    screen = (pixels - projection.middle) / projection.half
    # Before its division the projection is linear: s p is seen at s u + v.
    u, v = at @ projection.far.T, projection.matrix[:, 3] - projection.far @ projection.origin
    a, b = u[:, :2] - screen * u[:, 2:], v[:2] - screen * v[2]  # s a + b = 0 on the pixel's ray
    own = projection.project(frame.position[static].astype(np.float64))[1]
    depth = frame.depth[beside] / np.median(frame.depth[static] / own)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = -(a * b).sum(-1) / (a * a).sum(-1)
        (place, _), (far_place, away) = projection.project(at), projection.project(s[:, None] * at)
        off, left = (np.linalg.norm(each - pixels, axis=-1) for each in (place, far_place))
        return (s > 1) & (off > OFF) & (left < ON) & (np.abs(s * depth / away - 1) < LIKE)
