# SPDX-License-Identifier: MIT
"""Shapes that a ray meets in closed form, each about its own origin.

Points and directions are component-first, ``(3, N)``, so that each component is contiguous; a single origin or
direction is ``(3, 1)`` and broadcasts. Lengths are in cm, directions have unit length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from stss_ref.arrays import Array

_TINY = 1e-30  # stands in for a direction component of 0: the quotient is huge then, but finite
_UNBOUNDED = math.inf


class Shape(Protocol):
    """A surface: the interface of all shapes below."""

    @property
    def reach(self) -> float:
        """Radius about the origin of a ball that holds the shape; infinite for an unbounded one."""
        ...

    def distance(self, origin: Array, direction: Array) -> Array:
        """(N,) distance to the first point ahead of ``origin``; infinite where the ray misses."""
        ...

    def normal(self, point: Array) -> Array:
        """(3, N) unit normal at points of the surface; outward, or along the axis for a flat shape."""
        ...


def dot(a: Array, b: Array) -> Array:
    """(N,) dot product of two (3, N). Written out: a library call may sum in another order on another machine."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def safe_inverse(values: Array) -> Array:
    """``1 / values``, huge and finite where ``values`` is 0."""
    return 1.0 / np.where(values == 0, _TINY, values)


def first_ahead(near: Array, far: Array) -> Array:
    """The smaller of two ordered distances that lies ahead; infinite where neither does."""
    return np.where(near > 0, near, np.where(far > 0, far, np.inf))


@dataclass(frozen=True)
class Plane:
    """The part of the plane z = 0 with ``|x| <= half_x`` and ``|y| <= half_y``; unbounded by default."""

    half_x: float = _UNBOUNDED
    half_y: float = _UNBOUNDED

    @property
    def reach(self) -> float:
        """See `Shape.reach`."""
        return math.hypot(self.half_x, self.half_y)

    def distance(self, origin: Array, direction: Array) -> Array:
        """See `Shape.distance`."""
        distance = -origin[2] * safe_inverse(direction[2])
        x, y = origin[0] + distance * direction[0], origin[1] + distance * direction[1]
        return np.where((distance > 0) & (np.abs(x) <= self.half_x) & (np.abs(y) <= self.half_y), distance, np.inf)

    def normal(self, point: Array) -> Array:
        """See `Shape.normal`."""
        return np.stack([np.zeros_like(point[0]), np.zeros_like(point[0]), np.ones_like(point[0])])


@dataclass(frozen=True)
class Disc:
    """An upright disc that faces along y, or along z where ``flat``."""

    radius: float
    flat: bool = False

    @property
    def reach(self) -> float:
        """See `Shape.reach`."""
        return self.radius

    def distance(self, origin: Array, direction: Array) -> Array:
        """See `Shape.distance`."""
        across, along = (1, 2) if self.flat else (2, 1)
        distance = -origin[along] * safe_inverse(direction[along])
        x, y = origin[0] + distance * direction[0], origin[across] + distance * direction[across]
        return np.where((distance > 0) & (x * x + y * y <= self.radius**2), distance, np.inf)

    def normal(self, point: Array) -> Array:
        """See `Shape.normal`."""
        normal = np.zeros_like(point)
        normal[2 if self.flat else 1] = 1.0
        return normal


@dataclass(frozen=True)
class Sphere:
    """A sphere."""

    radius: float

    @property
    def reach(self) -> float:
        """See `Shape.reach`."""
        return self.radius

    def distance(self, origin: Array, direction: Array) -> Array:
        """See `Shape.distance`."""
        middle = -dot(origin, direction)
        # radius² - |closest point|², not b² - c: the latter cancels where the sphere is far away.
        inside = self.radius**2 - dot(closest := origin + middle * direction, closest)
        half = np.sqrt(np.maximum(inside, 0))
        return np.where(inside > 0, first_ahead(middle - half, middle + half), np.inf)

    def normal(self, point: Array) -> Array:
        """See `Shape.normal`."""
        return point / np.sqrt(dot(point, point))


@dataclass(frozen=True)
class Box:
    """A box with ``|x|, |y|, |z|`` up to the three half lengths."""

    half: tuple[float, float, float]

    @property
    def reach(self) -> float:
        """See `Shape.reach`."""
        return math.hypot(*self.half)

    def distance(self, origin: Array, direction: Array) -> Array:
        """See `Shape.distance`."""
        near: Array = np.full(1, -np.inf)
        far: Array = np.full(1, np.inf)
        for o, d, half in zip(origin, direction, self.half, strict=True):
            inverse = safe_inverse(d)
            middle, spread = -o * inverse, half * np.abs(inverse)
            near, far = np.maximum(near, middle - spread), np.minimum(far, middle + spread)
        return np.where(near <= far, first_ahead(near, far), np.inf)

    def normal(self, point: Array) -> Array:
        """See `Shape.normal`."""
        face = np.argmax(np.abs(point) / np.array(self.half)[:, None], axis=0)
        return np.where(np.arange(3)[:, None] == face, np.where(point < 0, -1.0, 1.0), 0.0)


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder about z; ``half_height`` infinite makes a pole without ends, else it has two caps."""

    radius: float
    half_height: float = _UNBOUNDED

    @property
    def reach(self) -> float:
        """See `Shape.reach`."""
        return math.hypot(self.radius, self.half_height)

    def distance(self, origin: Array, direction: Array) -> Array:
        """See `Shape.distance`."""
        inverse = 1.0 / np.maximum(direction[0] ** 2 + direction[1] ** 2, _TINY)
        middle = -(origin[0] * direction[0] + origin[1] * direction[1]) * inverse
        x, y = origin[0] + middle * direction[0], origin[1] + middle * direction[1]
        inside = self.radius**2 - x * x - y * y
        half = np.sqrt(np.maximum(inside, 0) * inverse)
        near, far = middle - half, middle + half
        if math.isfinite(self.half_height):
            slope = safe_inverse(direction[2])
            centre, spread = -origin[2] * slope, self.half_height * np.abs(slope)
            near, far = np.maximum(near, centre - spread), np.minimum(far, centre + spread)
        return np.where((inside > 0) & (near <= far), first_ahead(near, far), np.inf)

    def normal(self, point: Array) -> Array:
        """See `Shape.normal`."""
        radius = np.hypot(point[0], point[1])
        cap = np.abs(point[2]) / self.half_height > radius / self.radius
        side = safe_inverse(radius)
        return np.where(
            cap,
            np.stack([np.zeros_like(radius), np.zeros_like(radius), np.sign(point[2])]),
            np.stack([point[0] * side, point[1] * side, np.zeros_like(radius)]),
        )
