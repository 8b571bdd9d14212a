# SPDX-License-Identifier: MIT
"""The parts of a scene: objects and a camera whose places are closed-form functions of the frame number.

World space is in cm, right-handed, z up. A path takes the frame number, so half a frame is a legal time too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from conformance.scenes.materials import Color, Material
from conformance.scenes.shapes import Shape, dot
from stss_ref.arrays import Array

Vector = tuple[float, float, float]
Pose = tuple[Vector, float]
"""Position of the origin, and the turn about z in radians."""


@dataclass(frozen=True)
class Object:
    """A shape with a material; it moves if it has a path, and stands at ``at``, turned by ``yaw``, if it has none.

    ``casts`` False spares the shadow rays to an object that nothing lies behind, such as the ground.
    """

    name: str
    shape: Shape
    material: Material
    at: Vector = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    path: Callable[[float], Pose] | None = None
    casts: bool = True

    def transform(self, frame: float) -> Transform:
        """Where the object is at ``frame``."""
        position, yaw = self.path(frame) if self.path else (self.at, self.yaw)
        return Transform(np.array(position)[:, None], math.cos(yaw), math.sin(yaw))


@dataclass(frozen=True)
class Transform:
    """The map between an object's own space and the world: turn about z, then shift."""

    position: Array
    cos: float
    sin: float

    def _turn(self, vectors: Array, sin: float) -> Array:
        if sin == 0 and self.cos == 1:
            return vectors
        x, y, z = vectors
        return np.stack([self.cos * x - sin * y, sin * x + self.cos * y, z])

    def to_world(self, points: Array) -> Array:
        """(3, N) points of the object, in world space."""
        return self.turn_to_world(points) + self.position

    def to_object(self, points: Array) -> Array:
        """(3, N) world points, in the object's space."""
        return self.turn_to_object(points - self.position)

    def turn_to_world(self, directions: Array) -> Array:
        """(3, N) directions of the object, in world space."""
        return self._turn(directions, self.sin)

    def turn_to_object(self, directions: Array) -> Array:
        """(3, N) world directions, in the object's space."""
        return self._turn(directions, -self.sin)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without roll.

    Attributes:
        position: where it is at a frame, cm.
        target: the point that it looks at, cm; never straight above or below ``position``.
        spread: half the image's width at distance 1.
    """

    position: Callable[[float], Vector]
    target: Callable[[float], Vector]
    spread: float = 0.58

    def view(self, frame: float, size: tuple[int, int]) -> View:
        """The camera at ``frame`` with an image of ``size`` (H, W)."""
        position, target = np.array(self.position(frame)), np.array(self.target(frame))
        forward = (target - position) / math.dist(target, position)
        right = np.array([forward[1], -forward[0], 0.0]) / math.hypot(forward[0], forward[1])
        return View(position[:, None], right, np.cross(forward, right), forward, 2 * self.spread / size[1], size)


@dataclass(frozen=True)
class View:
    """A camera at one moment, with an image: maps pixels to rays and points to pixels.

    Attributes:
        position: (3, 1) cm.
        right: (3,) unit, world space; ``down`` and ``forward`` likewise.
        down: (3,).
        forward: (3,).
        pixel: width and height of a pixel at distance 1. An image of twice the size halves it, and each pixel box of
            the smaller image is then the union of four of the larger.
        size: (H, W).
    """

    position: Array
    right: Array
    down: Array
    forward: Array
    pixel: float
    size: tuple[int, int]

    def rays(self, x: Array, y: Array) -> Array:
        """(3, N) unit directions through the pixel coordinates ``x``, ``y``, (N,) each."""
        height, width = self.size
        u, v = (x - 0.5 * (width - 1)) * self.pixel, (y - 0.5 * (height - 1)) * self.pixel
        direction = self.forward[:, None] + self.right[:, None] * u + self.down[:, None] * v
        return direction / np.sqrt(dot(direction, direction))

    def project(self, points: Array) -> Array:
        """(N, 2) pixel coordinates (x, y) of world points (3, N); NaN for a point that is not ahead of the camera."""
        return self.project_direction(points - self.position)

    def project_direction(self, directions: Array) -> Array:
        """(N, 2) pixel coordinates of points at infinity in the directions (3, N); NaN where not ahead."""
        height, width = self.size
        depth = dot(self.forward, directions)
        scale = 1.0 / (self.pixel * np.where(depth > 0, depth, np.nan))
        x = dot(self.right, directions) * scale + 0.5 * (width - 1)
        y = dot(self.down, directions) * scale + 0.5 * (height - 1)
        return np.stack([x, y], axis=-1)


@dataclass(frozen=True)
class Light:
    """A sun, and a sky that lights surfaces that face up more than those that face down.

    Attributes:
        toward: direction to the sun; any length.
        sun: its radiance on a surface that faces it.
        zenith: colour of the sky overhead.
        horizon: colour of the sky at the horizon.
        ground: light that comes from below.
        ambient: share of sky and ground light that reaches a surface.
        overcast: the sky is seen in one colour, that of the horizon.
    """

    toward: Vector = (-0.55, -0.45, 0.72)
    sun: Color = (0.92, 0.84, 0.7)
    zenith: Color = (0.16, 0.34, 0.72)
    horizon: Color = (0.72, 0.8, 0.88)
    ground: Color = (0.32, 0.28, 0.22)
    ambient: float = 0.42
    overcast: bool = False

    @property
    def direction(self) -> Array:
        """(3, 1) unit vector to the sun."""
        return np.array(self.toward)[:, None] / math.hypot(*self.toward)


@dataclass(frozen=True)
class Scene:
    """Everything `render` needs; the same scene and frame give the same bits."""

    name: str
    camera: Camera
    objects: tuple[Object, ...]
    light: Light = Light()

    @property
    def numbers(self) -> Array:
        """(objects,) numbers of the stencil: 0 for an object without a path, the others counted from 1."""
        moving = np.array([item.path is not None for item in self.objects], bool)
        return np.where(moving, np.cumsum(moving), 0).astype(np.float64)
