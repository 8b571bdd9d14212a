# SPDX-License-Identifier: MIT
"""Motion by the camera: of the background, which is infinitely far away, and of static geometry."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from stss.frames.buffers import Buffers
from stss.images.windows import PixelWindow
from stss.sequence.projection import Projection, solve_projection
from stss_ground.errors import InputError
from stss_ref.arrays import Array, Mask

MotionSource = Literal["files", "camera"]
MOTION_SOURCES: tuple[MotionSource, ...] = get_args(MotionSource)
"""The sources of the motion of surfaces that do not move themselves."""
LOOSE = 0.25
"""Pixels: if no projection fits positions better than this, they do not judge motion."""
WITHIN = 0.5
"""Pixels: if no projection fits positions better than this, they do not give the camera. Samples anywhere in their pixels are off by 0.4 in
the median, and determine the camera as well."""


class CameraError(InputError):
    """The camera that should give a frame its motion is not known."""


def static_surfaces(frame: Buffers) -> Mask:
    """(H, W) True where static geometry with a known position is seen."""
    return (
        (frame.stencil == 0)
        & np.isfinite(frame.depth)
        & np.isfinite(frame.position).all(axis=-1)
        & (frame.normal != 0).any(axis=-1)
    )


def projection_of(frame: Buffers) -> Projection | None:
    """The camera's projection, by the positions of static geometry; None where they do not determine it in all directions."""
    projection = solve_projection(frame.position, static_surfaces(frame))
    return None if projection is None or projection.residual > WITHIN or len(projection.axes) < 3 else projection


def projection_of_table(far: Array, place: Array, display: PixelWindow, canvas: PixelWindow) -> Projection:
    """The camera's projection by a table: ``far``, see `stss.sequence.camera.CameraPose`, and its ``place`` (3,), in cm."""
    rows, columns = display.within(canvas)
    height, width = display.size
    middle = np.array([columns.start + (width - 1) / 2, rows.start + (height - 1) / 2])
    matrix = np.concatenate([far * np.array([[1], [height / width], [1]]), np.zeros((3, 1))], axis=1)
    return Projection(matrix, np.eye(3), place, middle, width / 2, 0.0)


def background_motion(before: Projection, now: Projection, pixels: NDArray[np.intp]) -> Array:
    """Motion of points at infinity, from the camera's rotation; its path does not matter.

    A point far along ``d`` is seen at ``P d``, with the projection's matrix without its last column. So the previous frame shows at
    ``P_before P_now^-1 (x, y, 1)`` what now is at ``(x, y)``.

    Source: Hartley and Zisserman, Multiple View Geometry, section 13.4: the infinite homography.

    Args:
        before: of the previous frame.
        now: of this frame.
        pixels: (N, 2) x, y.

    Returns:
        (N, 2) float32; pixels, current -> previous, x right, y down; NaN where it was behind the camera.
    """
    screen = (pixels - now.middle) / now.half
    direction = np.linalg.solve(now.far, np.concatenate([screen, np.ones((len(screen), 1))], axis=1).T)
    u, v, w = before.far @ direction
    with np.errstate(divide="ignore", invalid="ignore"):
        there = np.stack([u / w, v / w], axis=-1) * before.half + before.middle
    there[~(w > 0)] = np.nan
    return (there - pixels).astype(np.float32)


def static_motion(before: Projection, now: Projection, places: Array) -> Array:
    """Motion of geometry at rest, from the camera alone: where the previous frame shows its places.

    Both frames are asked, so that a place that is not that of its pixel's centre, such as the mean of samples, does no harm.

    Args:
        before: of the previous frame.
        now: of this frame.
        places: (N, 3) world positions in cm.

    Returns:
        (N, 2) float32; pixels, current -> previous, x right, y down; NaN where it was behind the camera or has no position.
    """
    (there, away), (here, _) = before.project(places.astype(np.float64)), now.project(places.astype(np.float64))
    there[~(away > 0)] = np.nan
    return (there - here).astype(np.float32)
