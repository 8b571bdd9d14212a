# SPDX-License-Identifier: MIT
"""Materials: base colour, roughness and metallic as closed-form functions of the place on the object.

A pattern maps object-space points ``(3, N)`` in cm to weights ``(N,)`` in [0, 1]; a material mixes two finishes by it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stss_ref.arrays import Array

Color = tuple[float, float, float]
Pattern = Callable[[Array], Array]


class Surface(NamedTuple):
    """A material at N points: base_color (3, N), roughness (N,), metallic (N,), each in [0, 1]."""

    base_color: Array
    roughness: Array
    metallic: Array


class Finish(NamedTuple):
    """One of the two ends that a material mixes."""

    color: Color
    roughness: float = 0.7
    metallic: float = 0.0


@dataclass(frozen=True)
class Material:
    """``first`` where the pattern is 0, ``second`` where it is 1; ``wear`` darkens the colour where its pattern is 1.

    Attributes:
        first: the finish at weight 0.
        second: the finish at weight 1; None is ``first`` everywhere.
        pattern: the weight; None is 0 everywhere.
        wear: a second pattern; None leaves the colour as it is.
        depth: how much ``wear`` takes away, in [0, 1].
    """

    first: Finish
    second: Finish | None = None
    pattern: Pattern | None = None
    wear: Pattern | None = None
    depth: float = 0.3

    def at(self, point: Array) -> Surface:
        """The surface at object-space points (3, N)."""
        weight = self.pattern(point) if self.pattern else np.zeros_like(point[0])
        a, b = self.first, self.second or self.first
        color = np.stack([low + (high - low) * weight for low, high in zip(a.color, b.color, strict=True)])
        if self.wear:
            color = color * (1 - self.depth * self.wear(point))
        roughness = a.roughness + (b.roughness - a.roughness) * weight
        return Surface(color, roughness, a.metallic + (b.metallic - a.metallic) * weight)


def checker(side: float, *, axes: tuple[int, ...] = (0, 1)) -> Pattern:
    """Alternating cells of ``side`` cm along ``axes``."""

    def pattern(point: Array) -> Array:
        cells = sum(np.floor(point[axis] / side) for axis in axes)
        return np.mod(cells, 2.0)

    return pattern


def stripes(period: float, *, axis: int, share: float = 0.5) -> Pattern:
    """Bands across ``axis``: the first ``share`` of each period is 1."""

    def pattern(point: Array) -> Array:
        return (np.mod(point[axis] / period, 1.0) < share).astype(point.dtype)

    return pattern


def sectors(count: int) -> Pattern:
    """``count`` alternating sectors around z, ``count`` even: a beach ball."""

    def pattern(point: Array) -> Array:
        return np.mod(np.floor(np.arctan2(point[1], point[0]) * (count / (2 * np.pi))), 2.0)

    return pattern


def bricks(length: float, height: float, joint: float) -> Pattern:
    """1 on the joints of a running bond in the xz plane, 0 on the bricks; all in cm."""

    def pattern(point: Array) -> Array:
        row = np.floor(point[2] / height)
        along = np.mod(point[0] + 0.5 * length * np.mod(row, 2.0), length)
        return ((along < joint) | (point[2] - row * height < joint)).astype(point.dtype)

    return pattern


def rings(period: float, *, axes: tuple[int, int] = (0, 2)) -> Pattern:
    """Concentric rings in the plane of ``axes``: a target."""

    def pattern(point: Array) -> Array:
        return (np.mod(np.hypot(point[axes[0]], point[axes[1]]) / period, 1.0) < 0.5).astype(point.dtype)

    return pattern


def noise(scale: float) -> Pattern:
    """Smooth spots about ``scale`` cm wide: a sum of sines, none of which is a multiple of another."""
    waves = ((1.0, 0.31, 0.57, 0.0), (-0.43, 1.13, 0.29, 1.7), (0.71, -0.83, 1.37, 4.1), (-1.61, -0.59, -0.97, 2.3))

    def pattern(point: Array) -> Array:
        u = point * (np.pi / scale)
        total = np.zeros_like(point[0])
        for a, b, c, phase in waves:
            total += np.sin(a * u[0] + b * u[1] + c * u[2] + phase)
        return 0.5 + total / (2 * len(waves))

    return pattern
