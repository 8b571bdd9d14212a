# SPDX-License-Identifier: MIT
"""Convert what a renderer stored to the conventions of spec section 0."""

from __future__ import annotations

import numpy as np

from stss.sequence.camera import CameraPose
from stss.sequence.profiles import DepthRule, MotionRule, NormalRule
from stss_ref.arrays import Array, Image, Mask, Plane


def motion_in_pixels(stored: Image, rule: MotionRule) -> Image:
    """Stored motion as (H, W, 2) float32; pixels, current -> previous, x right, y down. Non-finite values stay so."""
    height, width = stored.shape[:2]
    unit = {"pixels": (1.0, 1.0), "uv": (width, height), "ndc": (width / 2, height / 2)}[rule.unit]
    sign = 1.0 if rule.direction == "to_previous" else -1.0
    factor = np.array(rule.scale) * unit * (sign, sign if rule.y == "down" else -sign)
    with np.errstate(invalid="ignore", over="ignore"):
        return ((stored - np.array(rule.bias)) * factor + 0.0).astype(np.float32)  # + 0.0: no negative zeros


def linear_depth(stored: Plane, rule: DepthRule) -> Plane:
    """Stored depth as linear depth (H, W) float32, infinite where nothing was hit; a ray's length stays one, see `ray_to_planar`."""
    d = stored.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        if rule.kind == "device":
            d = np.clip(d, 0, 1)
            d = d if rule.reversed else 1 - d
            # d is 1 at the near plane, 0 at the far one; 1 / z is linear in it.
            d = 1 / (d / rule.near + (1 - d) / rule.far)
            hit = np.isfinite(d) & (d < rule.far * (1 - 1e-6))
        else:
            hit = np.isfinite(d) & (d > 0) & (d < rule.background)
    return np.where(hit, d, np.inf).astype(np.float32)


def ray_to_planar(depth: Plane, position: Image, camera: CameraPose | None) -> Plane:
    """Turn distances to the camera (H, W) into depths along its axis; unchanged where the axis is not known.

    ``position`` is in scene units. The depth comes from it, not from the ray: ``|z|`` in camera space.
    """
    if camera is None or camera.to_camera is None:
        return depth
    z = np.abs(position.astype(np.float64) @ camera.to_camera[2, :3] + camera.to_camera[2, 3])
    usable = np.isfinite(depth) & np.isfinite(z) & (z > 0)
    return np.where(usable, z, depth).astype(np.float32)


def world_normal(stored: Image, rule: NormalRule) -> tuple[Image, Mask]:
    """The stored normal as (H, W, 3) float32, and (H, W) True where its value means that nothing was hit."""
    missed = np.zeros(stored.shape[:2], dtype=np.bool_)
    if rule.background is not None:
        missed = (stored == np.array(rule.background, dtype=np.float32)).all(axis=-1)
    with np.errstate(invalid="ignore", over="ignore"):
        return ((stored - rule.bias) * rule.scale).astype(np.float32), missed


def normal_dot_view(normal: Image, position: Image, camera: Array) -> Plane:
    """NoV (H, W): ``dot(normalize(normal), normalize(camera - position))``, 0 where either has no length or is not finite."""
    n = normal.astype(np.float64)
    view = camera - position.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        nov = (n * view).sum(axis=-1) / np.sqrt((n * n).sum(axis=-1) * (view * view).sum(axis=-1))
    return np.where(np.isfinite(nov), np.clip(nov, -1, 1), 0).astype(np.float32)
