# SPDX-License-Identifier: MIT
"""Whether a plane is that of the previous frame: its edges are then where that frame has its silhouettes."""

from __future__ import annotations

import numpy as np

from stss.check_sequence.value_statistics import Line
from stss.frames.buffers import Buffers
from stss_ref.arrays import Array, Image, Mask

STEP = 4.0
"""At a silhouette the step between two pixels is larger than the mean of the steps on its two sides by this factor."""
BEND = 0.3
"""Normals of two surfaces differ by more in one component."""
EDGES = 50
"""Fewest edges that allow a judgement."""
TIMES = 2.0
"""A plane is late if more of its edges are the previous frame's than its own by this factor. Found: 2.6 and more where it is, 0.4 and
less where it is not, in the reference films and the scenes of the judge. Normals are nearest, since they have edges within surfaces."""
SHARE = 0.35
"""And if more than this share of the edges that are not its own are the previous frame's. Found: 0.48 and more where it is late, 0.28 and
less if objects' numbers reach a pixel too far, as an outline does. Normals may have most of their edges within surfaces."""
JUDGED = {"position": "depth", "depth": "position", "normal": "position", "stencil": "position"}
"""A plane, and the one that shows the silhouettes."""


class LatePlanes:
    """Counts edges of planes that are silhouettes in one of two frames alone: in this one, or in the previous one.

    All other pixels look alike in both frames, so a floor has no say, however large it is.
    """

    def __init__(self):
        self._counts = {plane: np.zeros(3, np.int64) for plane in JUDGED}
        """Of each plane: edges that are silhouettes of this frame, of the previous one, and all that are none of this frame."""

    def add(self, before: Buffers, now: Buffers) -> None:
        """Count those of two neighbouring frames."""
        hit = _both(np.isfinite(before.depth) & np.isfinite(now.depth))
        earlier, own = ({"position": _silhouettes(f.position), "depth": _silhouettes(_inverse(f))} for f in (before, now))
        edges = own | {"normal": _steps(now.normal) > BEND, "stencil": _steps(now.stencil[..., None]) > 0}
        for plane, by in JUDGED.items():
            edge, a, b = edges[plane] & hit, own[by], earlier[by]
            self._counts[plane] += (edge & a & ~b).sum(), (edge & b & ~a).sum(), (edge & ~a).sum()

    @property
    def names(self) -> tuple[str, ...]:
        """The planes of the previous frame; only the position if it is one, since others are judged by it."""
        late = tuple(
            plane
            for plane, (own, earlier, others) in self._counts.items()
            if earlier >= max(EDGES, TIMES * own) and (plane == "normal" or earlier > SHARE * others)
        )
        return ("position",) if "position" in late else late


def late_lines(names: tuple[str, ...]) -> list[Line]:
    """Findings about the late planes ``names``."""
    return [
        ("warning", f"{name}: that of the previous frame, by {JUDGED[name]}; expected planes of one moment") for name in names
    ]


def _inverse(frame: Buffers) -> Image:
    """(H, W, 1) 1 / depth, which is linear in x and y over a plane."""
    with np.errstate(divide="ignore"):
        return 1 / frame.depth[..., None].astype(np.float64)


def _steps(plane: Image) -> Array:
    """(2, H, W) the largest difference of a component to the right and the lower neighbour; 0 at the border."""
    values = plane.astype(np.float64)
    with np.errstate(invalid="ignore"):
        across, down = (np.abs(np.diff(values, axis=axis)).max(axis=-1) for axis in (1, 0))
    return np.stack([np.pad(across, ((0, 0), (0, 1))), np.pad(down, ((0, 1), (0, 0)))])


def _silhouettes(plane: Image) -> Mask:
    """(2, H, W) True where the right and the lower neighbour are of another surface, by a plane without steps within surfaces."""
    steps = _steps(plane)
    mask = np.zeros(steps.shape, np.bool_)
    with np.errstate(invalid="ignore"):
        for i, axis in enumerate((1, 0)):
            row, found = (np.moveaxis(of[i], axis, 0) for of in (steps, mask))
            found[1:-1] = row[1:-1] > STEP * (row[:-2] + row[2:]) / 2
    return mask


def _both(mask: Mask) -> Mask:
    """(2, H, W) True where a pixel and its right, or lower, neighbour are in ``mask``."""
    both = np.zeros((2, *mask.shape), np.bool_)
    both[0, :, :-1], both[1, :-1] = mask[:, 1:] & mask[:, :-1], mask[1:] & mask[:-1]
    return both
