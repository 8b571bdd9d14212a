# SPDX-License-Identifier: MIT
"""The camera of a frame from its own position and depth: no table is needed where both are there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from stss.sequence.camera import CameraPose
from stss.sequence.conventions import linear_depth
from stss.sequence.profiles import Profile
from stss.sequence.projection import some_pixels
from stss_ground.errors import InputError
from stss_ref.arrays import Array, Image, Plane

ROUNDS = 4
"""Number of fits; each leaves out the pixels that the previous one fits worst: mixtures at silhouettes."""
MIN_PIXELS = 16
"""Fewest pixels that determine the unknowns with a margin."""
MAX_RESIDUAL = 1e-2
"""Largest residual of a camera that is used: the error of NoV is no larger."""


@dataclass(frozen=True)
class SolvedCamera:
    """A camera that fits a frame.

    Attributes:
        pose: its position, in scene units.
        residual: median distance between the stored positions and those that the camera and the depths give, as a share of the median
            distance.
    """

    pose: CameraPose
    residual: float


def solve_camera(depth: Plane, position: Image, *, ray: bool = False) -> SolvedCamera | None:
    """Find the camera's position.

    Planar depth: ``position = C + depth M (x, y, 1)`` is linear in ``C`` and ``M``. Distance along the ray:
    ``|position|^2 - depth^2 = 2 position . C - |C|^2`` is linear in ``C`` and ``|C|^2``.

    Args:
        depth: (H, W) not normalised, in any unit where it is planar; infinite where nothing was hit.
        position: (H, W, 3) world position, in scene units.
        ray: whether ``depth`` is the distance along the ray.

    Returns:
        The camera; None if too few pixels see a surface, or if that surface does not determine it.
    """
    y, x = some_pixels(np.isfinite(depth) & np.isfinite(position).all(axis=-1))
    if len(y) < MIN_PIXELS:
        return None
    d, p = depth[y, x].astype(np.float64), position[y, x].astype(np.float64)
    middle = p.mean(axis=0)
    p -= middle
    if not p.any():  # one place everywhere, as of a pass that was not rendered
        return None
    if ray:
        unknowns, right_side = np.column_stack([2 * p, np.ones(len(d))]), ((p * p).sum(axis=1) - d * d)[:, None]
    else:
        u, v = x / depth.shape[1] - 0.5, y / depth.shape[0] - 0.5
        unknowns, right_side = np.column_stack([np.ones(len(d)), d * u, d * v, d]), p
    inliers, solution, error = np.ones(len(d), np.bool_), unknowns[:0], d
    for _ in range(ROUNDS):
        scale = np.maximum(np.abs(unknowns[inliers]).max(axis=0), np.finfo(np.float64).tiny)
        solution, _, rank, _ = np.linalg.lstsq(unknowns[inliers] / scale, right_side[inliers], rcond=1e-9)
        if rank < unknowns.shape[1]:
            return None
        solution /= scale[:, None]
        error = np.linalg.norm(unknowns @ solution - right_side, axis=1)
        inliers = error <= max(3 * float(np.median(error[inliers])), float(np.sort(error)[MIN_PIXELS - 1]))
    camera: Array = solution[:3, 0] if ray else solution[0]
    away = float(np.median(np.linalg.norm(p - camera, axis=1)))
    typical = float(np.median(error)) / (2 * away if ray else 1.0)
    return SolvedCamera(CameraPose(camera + middle), typical / away)


def solve_pose(where: str, arrays: Mapping[str, Array], profile: Profile) -> CameraPose:
    """Find the camera's position for the NoV of a frame.

    Args:
        where: the frame, for errors.
        arrays: its depth and position as stored.
        profile: says what they mean.

    Raises:
        InputError: they do not give it.
    """
    rule = profile.depth
    depth = linear_depth(arrays["depth"][..., 0], rule)
    if not np.isfinite(depth).any():  # a sky alone has NoV 0 from any place
        return CameraPose(np.zeros(3))
    camera = solve_camera(depth, arrays["position"], ray=rule.kind == "ray")
    if camera is None or camera.residual > MAX_RESIDUAL:
        reason = "too few surfaces" if camera is None else f"they differ by {camera.residual:.1g} of the distance"
        depths, counts = np.unique(depth[np.isfinite(depth)], return_counts=True)
        if len(depths) > 1 and depths[-1] > 2 * depths[-2] and counts[-1] >= MIN_PIXELS:
            reason += (
                f"; {counts[-1]} pixels have depth {depths[-1]:g}: if nothing was hit there, give a profile with this background"
            )
        raise InputError(
            f"{where}: no nov and no camera, and position and depth do not give one ({reason}): give --camera CSV "
            f"(frame,x,y,z in the scene's unit) or a channel {' or '.join(names[0] for names in profile.channels['nov'])}, "
            "without which no orthographic camera can do"
        )
    return camera.pose
