# SPDX-License-Identifier: MIT
"""The projection of a frame, from its positions alone: which pixel shows which place of the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stss_ref.arrays import Array, Image, Mask
from stss_ref.sample import Index

PIXELS = 20_000
"""Most pixels that are looked at, evenly spread."""
MIN_PIXELS = 100
"""Fewest pixels that determine the unknowns with something to spare."""
ROUNDS = 5
"""Fits, each without the pixels that the one before it fits worst."""
FLAT = 1e-4
"""A scene is flat where its extent in one direction is below this share of the largest."""


@dataclass(frozen=True)
class Projection:
    """Where places are seen: ``w (x, y, 1) = matrix (axes (p - origin), 1)``.

    Attributes:
        matrix: (3, k + 1), in units of the frame's half width; ``w`` is positive in front of the camera.
        axes: (k, 3) the directions in which the scene extends, over its extent; 3 of them, or 2 where it is flat.
        origin: (3,) the middle of the scene.
        middle, half: of the frame; pixels.
        residual: median distance of a pixel to where its own position is projected; pixels.
    """

    matrix: Array
    axes: Array
    origin: Array
    middle: Array
    half: float
    residual: float

    @property
    def mirrored(self) -> bool | None:
        """Whether the frame is seen as in a mirror: upside down, or in a left-handed world; None where the scene is flat."""
        return None if len(self.axes) < 3 else bool(np.linalg.det(self.far) < 0)

    @property
    def far(self) -> Array:
        """(3, 3): takes directions of the world to homogeneous places in the frame; of a scene that is not flat."""
        return self.matrix[:, :3] @ self.axes

    @property
    def camera(self) -> Array | None:
        """(3,) where the camera is, the place that is projected nowhere; None where the scene is flat."""
        if len(self.axes) < 3:
            return None
        return self.origin - np.linalg.solve(self.far, self.matrix[:, 3])

    def project(self, position: Array) -> tuple[Array, Array]:
        """(N, 2) pixels x, y of places (N, 3), and (N,) their distance along the view, in some unit; below 0 behind the camera."""
        x, y, w = self.matrix @ _homogeneous(self.axes, position - self.origin)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([x / w, y / w], axis=-1) * self.half + self.middle, w


def some_pixels(mask: Mask) -> tuple[Index, Index]:
    """Rows and columns of the pixels of a mask (H, W), of `PIXELS` at most."""
    y, x = np.nonzero(mask)
    some = slice(None) if len(y) <= PIXELS else np.linspace(0, len(y) - 1, PIXELS).astype(int)
    return y[some], x[some]


def solve_projection(position: Image, mask: Mask) -> Projection | None:
    """Solve for the projection of a frame by least squares over its pixels.

    Args:
        position: (H, W, 3).
        mask: (H, W) the pixels to look at.

    Returns:
        The projection; None where too few pixels are seen, or they are of a line or a point.
    """
    y, x = some_pixels(mask & np.isfinite(position).all(axis=-1))
    if len(y) < MIN_PIXELS:
        return None
    p = position[y, x].astype(np.float64)
    origin = np.median(p, axis=0)
    squares, directions = np.linalg.eigh(np.cov((p - origin).T))
    extent = np.sqrt(np.maximum(squares, 0))
    wide = extent > FLAT * extent[-1]
    if wide.sum() < 2:
        return None
    axes = (directions[:, wide] / extent[wide]).T
    height, width = mask.shape
    middle, half = np.array([width - 1, height - 1]) / 2, width / 2
    pixels = np.stack([x, y], axis=-1)
    u, v = ((pixels - middle) / half).T
    q = _homogeneous(axes, p - origin)
    weight, is_inlier = np.ones(len(u)), np.ones(len(u), np.bool_)
    projection = None
    for _ in range(ROUNDS):
        a, zero = q * weight * is_inlier, np.zeros_like(q)
        rows = np.concatenate([np.concatenate([a, zero, -u * a]), np.concatenate([zero, a, -v * a])], axis=1)
        matrix = np.linalg.eigh(rows @ rows.T)[1][:, 0].reshape(3, len(q))
        w = matrix[2] @ q
        if np.median(w) < 0:
            matrix, w = -matrix, -w
        projection = Projection(matrix, axes, origin, middle, half, 0.0)
        error = np.where(w > 0, np.linalg.norm(projection.project(p)[0] - pixels, axis=-1), np.inf)
        typical = float(np.median(error))
        if not np.isfinite(typical):
            return None
        projection = Projection(matrix, axes, origin, middle, half, typical)
        is_inlier = error <= max(3 * typical, 1e-9)
        weight = 1 / np.maximum(w, 1e-3 * float(np.median(w)))  # then the residual is in pixels
    return projection


def _homogeneous(axes: Array, offset: Array) -> Array:
    """(k + 1, N): the offsets (N, 3) along the axes, and a row of 1."""
    return np.concatenate([axes @ offset.T, np.ones((1, len(offset)))])
