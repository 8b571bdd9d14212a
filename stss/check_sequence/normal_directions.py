# SPDX-License-Identifier: MIT
"""Whether normals are those of the surfaces that positions form; the surfaces of each direction have one vote."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stss.check_sequence.value_statistics import Line
from stss.frames.buffers import Buffers
from stss.sequence.background import static_surfaces
from stss.sequence.projection import Projection
from stss_ref.arrays import Array, Image, Mask

FLAT = 0.1
"""A surface counts where its positions' second differences are below this share of the first."""
SHARE = 0.005
"""Least share of the frame of surfaces that face one way, for their mean normal to count."""
ROUNDING = 0.01
"""A unit normal's length differs by less from 1."""
TILT = 5.0
"""Degrees: the least angle between the mean normals of one direction, as stored and by positions, from which there is a warning. Found:
up to 2.2 in the reference films, whose normals are bent by maps, smooth shading and leaves."""
SLANT = 2.5
"""The same if normals are in the camera's space, which leaves nothing to fit."""
FITS = 0.25
"""Normals are rotated if a rotation leaves less than this share of the angle."""


@dataclass(frozen=True)
class NormalVerdict:
    """The largest angle of any direction between stored normals and those of positions; degrees.

    Attributes:
        stored: as stored.
        turned: after the rotation, or reflection, that fits best.
        camera: after they are taken from the camera's space to that of positions.
    """

    stored: float = 0.0
    turned: float = 0.0
    camera: float = 0.0

    def lines(self) -> list[Line]:
        """Findings."""
        if self.stored > SLANT and self.camera < min(FITS * self.stored, self.turned + SLANT):
            return [("warning", "normal: in the camera's space; expected world space, as that of positions")]
        if self.stored > TILT and self.turned < FITS * self.stored:
            text = f"normal: rotated against positions, or mirrored, by {self.stored:.0f} degrees on some surfaces"
            return [("warning", f"{text}; expected both in world space")]
        return []


def judge_normals(frame: Buffers, projection: Projection) -> NormalVerdict:
    """The angles of one frame, whose positions have this ``projection``."""
    by_position, flat = _normals_of(frame.position)
    hit = static_surfaces(frame) & np.isfinite(frame.normal).all(axis=-1)
    normals = frame.normal[hit].astype(np.float64)
    if not len(normals) or (normals.min() >= 0 and np.median(np.abs(np.linalg.norm(normals, axis=-1) - 1)) > ROUNDING):
        return NormalVerdict()  # stored as 0..1, which another finding says
    mask = flat & hit[1:-1, 1:-1]
    stored, right = _directions(frame.normal[1:-1, 1:-1][mask].astype(np.float64), by_position[mask], SHARE * hit.size)
    if not len(stored):
        return NormalVerdict()
    if (stored * right).sum() < 0:  # the cross product may point away from the camera, but then it does so everywhere
        right = -right
    u, _, v = np.linalg.svd(stored.T @ right)
    turned = _worst(stored @ (u @ v), right) if np.linalg.matrix_rank(right) > 1 else 180.0  # of one vector, any fits
    views = [
        _worst(stored * signs @ axes, right)
        for axes in _camera_axes(projection)
        for signs in ((1, 1, 1), (1, -1, -1), (1, -1, 1))
    ]
    return NormalVerdict(_worst(stored, right), turned, min(views, default=180.0))


def _normals_of(position: Image) -> tuple[Image, Mask]:
    """Unit normals of surfaces, but for their sign, without the border's pixels; and where the surface is flat."""
    p = position.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        across, down = (p[1:-1, 2:] - p[1:-1, :-2]), (p[2:, 1:-1] - p[:-2, 1:-1])
        bend = np.abs(p[1:-1, 2:] + p[1:-1, :-2] - 2 * p[1:-1, 1:-1]) + np.abs(p[2:, 1:-1] + p[:-2, 1:-1] - 2 * p[1:-1, 1:-1])
        flat = bend.sum(axis=-1) < FLAT * np.minimum(np.linalg.norm(across, axis=-1), np.linalg.norm(down, axis=-1))
        normals = np.cross(across, down)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals, flat & np.isfinite(normals).all(axis=-1)


def _directions(stored: Array, right: Array, pixels: float) -> tuple[Array, Array]:
    """(N, 3) unit means of both, one for each of the axes' six directions that is nearest to at least ``pixels`` of ``right``."""
    axis = np.abs(right).argmax(axis=-1)
    direction = 2 * axis + (np.take_along_axis(right, axis[:, None], axis=-1)[:, 0] < 0)
    groups = [direction == k for k in range(6) if (direction == k).sum() >= pixels]
    means = [np.array([of[group].mean(axis=0) for group in groups]).reshape(-1, 3) for of in (stored, right)]
    a, b = (of / np.maximum(np.linalg.norm(of, axis=-1, keepdims=True), np.finfo(np.float64).tiny) for of in means)
    return a, b


def _camera_axes(projection: Projection) -> list[Array]:
    """The rows right, down and forward of the camera in the world; none where the scene is flat."""
    if len(projection.axes) < 3:
        return []
    right, down, forward = projection.far
    forward = forward / np.linalg.norm(forward)
    rows = [row - (row @ forward) * forward for row in (right, down)]  # which have the place of the frame's middle, too
    return [np.stack([*(row / np.linalg.norm(row) for row in rows), forward])]


def _worst(stored: Array, right: Array) -> float:
    return float(np.degrees(np.arccos(np.clip((stored * right).sum(axis=-1), -1, 1))).max())
