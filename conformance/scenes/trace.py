# SPDX-License-Identifier: MIT
"""Rays into a scene at one moment: the surfaces that they hit, and the light that comes back along them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from conformance.scenes.materials import Color, Surface, noise
from conformance.scenes.scene import Light, Scene, Transform
from conformance.scenes.shapes import dot
from stss_ref.arrays import Array

Indices = NDArray[np.integer]
SKY = -1
_LIFT = 1e-3  # cm along the normal: a shadow or mirror ray must not meet the surface it starts on
_MIRROR = 0.3  # metals below this roughness reflect the scene
_CLOUDS = noise(0.9)


class Hits(NamedTuple):
    """The hits of N rays.

    Attributes:
        distance: (N,) cm; infinite where nothing was hit.
        which: (N,) position in `Scene.objects`; `SKY` where nothing was hit.
        point: (3, N) world space, cm; 0 where nothing was hit.
        local: (3, N) the same point in the object's own space.
        normal: (3, N) unit, towards the ray's origin; 0 where nothing was hit.
        surface: the material there; 0 where nothing was hit.
    """

    distance: Array
    which: Indices
    point: Array
    local: Array
    normal: Array
    surface: Surface


@dataclass(frozen=True)
class Moment:
    """A scene with every object in its place at one frame."""

    scene: Scene
    transforms: tuple[Transform, ...]

    @classmethod
    def of(cls, scene: Scene, frame: float) -> Moment:
        """``scene`` at ``frame``."""
        return cls(scene, tuple(item.transform(frame) for item in scene.objects))

    def hit(self, origin: Array, direction: Array, among: list[int] | None = None) -> Hits:
        """Follow rays from ``origin`` (3, N) or (3, 1) along ``direction`` (3, N); only objects ``among`` are tried."""
        distance: Array = np.full(direction.shape[1], np.inf)
        index = np.full(direction.shape[1], SKY)
        for i in range(len(self.transforms)) if among is None else among:
            transform = self.transforms[i]
            away = self.scene.objects[i].shape.distance(transform.to_object(origin), transform.turn_to_object(direction))
            closer = away < distance
            distance, index = np.where(closer, away, distance), np.where(closer, i, index)
        point = np.where(index == SKY, 0.0, origin + np.where(index == SKY, 0.0, distance) * direction)
        return self._describe(distance, index, point, direction)

    def _describe(self, distance: Array, index: Indices, point: Array, direction: Array) -> Hits:
        local, normal, color = np.zeros_like(point), np.zeros_like(point), np.zeros_like(point)
        roughness, metallic = np.zeros_like(distance), np.zeros_like(distance)
        for i in np.unique(index[index != SKY]):
            (here,) = np.nonzero(index == i)
            transform, item = self.transforms[i], self.scene.objects[i]
            local[:, here] = at = transform.to_object(np.take(point, here, axis=1))
            outward = transform.turn_to_world(item.shape.normal(at))
            normal[:, here] = np.where(dot(outward, np.take(direction, here, axis=1)) > 0, -outward, outward)
            color[:, here], roughness[here], metallic[here] = item.material.at(at)
        return Hits(distance, index, point, local, normal, Surface(color, roughness, metallic))

    def in_beam(self, apex: Array, direction: Array) -> list[int]:
        """The objects that rays from ``apex`` (3, 1) along ``direction`` (3, N) may hit: by their balls."""
        axis = direction.mean(axis=1, keepdims=True)
        axis = axis / math.hypot(*axis[:, 0])
        beam = math.acos(min(1.0, float(dot(axis, direction).min())))
        hits: list[int] = []
        for i, (item, transform) in enumerate(zip(self.scene.objects, self.transforms, strict=True)):
            offset = (transform.position - apex)[:, 0]
            away, reach = math.hypot(*offset), item.shape.reach
            if away <= reach or _angle(offset, axis[:, 0], away) <= beam + math.asin(reach / away) + 1e-6:
                hits.append(i)
        return hits

    def lit(self, point: Array, normal: Array) -> NDArray[np.bool_]:
        """(N,) True where no object stands between ``point`` (3, N) and the sun, and the surface faces it."""
        sun = self.scene.light.direction
        lit = dot(normal, sun) > 0
        origin = np.compress(lit, point + _LIFT * normal, axis=1)
        clear = np.ones(origin.shape[1], bool)
        if origin.shape[1] == 0:
            return lit
        centre = origin.mean(axis=1, keepdims=True)
        spread = math.sqrt(float(dot(origin - centre, origin - centre).max()))
        for item, transform in zip(self.scene.objects, self.transforms, strict=True):
            offset, reach = (transform.position - centre)[:, 0], item.shape.reach + spread
            along = float(offset @ sun[:, 0])
            aside = math.hypot(*(offset - along * sun[:, 0]))
            if item.casts and along >= -reach and aside <= reach:
                clear &= np.isinf(item.shape.distance(transform.to_object(origin), transform.turn_to_object(sun)))
        lit[lit] = clear
        return lit

    def radiance(self, hits: Hits, direction: Array, bounces: int = 1) -> Array:
        """(3, N) scene-linear light that comes back along rays with ``direction`` (3, N), which hit ``hits``."""
        color = np.empty_like(direction)
        above = hits.which == SKY
        color[:, above] = sky(self.scene.light, direction[:, above])
        (ground,) = np.nonzero(~above)
        if ground.size == 0:
            return color
        point, normal, ray = (np.take(a, ground, axis=1) for a in (hits.point, hits.normal, direction))
        surface = Surface(*(np.take(a, ground, axis=-1) for a in hits.surface))
        mirrored = ray - 2 * dot(ray, normal) * normal
        around = sky_light(self.scene.light, mirrored[2])
        (mirror,) = np.nonzero((surface.metallic > 0.5) & (surface.roughness < _MIRROR))
        if bounces and mirror.size:
            origin, onward = (point + _LIFT * normal)[:, mirror], mirrored[:, mirror]
            around[:, mirror] = self.radiance(self.hit(origin, onward), onward, bounces - 1)
        color[:, ground] = _shade(self.scene.light, surface, normal, ray, around, lit=self.lit(point, normal))
        return color


def _angle(offset: Array, axis: Array, away: float) -> float:
    return math.acos(max(-1.0, min(1.0, float(offset @ axis) / away)))


def _column(color: Color) -> Array:
    return np.array(color)[:, None]


def sky(light: Light, direction: Array) -> Array:
    """(3, N) the sky along unit directions (3, N): a gradient, soft clouds, and a glow about the sun."""
    height = np.clip(direction[2], 0, 1)
    if light.overcast:
        return np.repeat(_column(light.horizon), direction.shape[1], axis=1)
    color = _column(light.horizon) + (_column(light.zenith) - _column(light.horizon)) * np.sqrt(height)
    clouds = np.clip(3 * _CLOUDS(direction / (height + 0.12)) - 1.6, 0, 1) * np.clip(6 * height, 0, 1)
    color = color + (0.95 - color) * (0.7 * clouds)
    glow = np.square(np.square(np.maximum(dot(direction, light.direction), 0)))
    return color + _column(light.sun) * np.square(np.square(np.square(np.square(glow))))  # to the 64th: ** is slow


def sky_light(light: Light, up: Array) -> Array:
    """(3, N) light from the half of the surroundings that lies about a direction with z component ``up`` (N,)."""
    above = _column(light.horizon) + (_column(light.zenith) - _column(light.horizon)) * 0.4
    return _column(light.ground) + (above - _column(light.ground)) * (0.5 + 0.5 * up)


def _shade(light: Light, surface: Surface, normal: Array, ray: Array, around: Array, *, lit: NDArray[np.bool_]) -> Array:
    """Lambert and a normalised Blinn-Phong lobe from the sun, light of the sky, and ``around`` in metal."""
    color, roughness, metallic = surface
    sun = np.where(lit, dot(normal, light.direction), 0.0)
    half = light.direction - ray
    half = half / np.sqrt(np.maximum(dot(half, half), 1e-12))
    power = 2 / np.square(np.square(np.maximum(roughness, 0.05)))
    lobe = np.minimum((power + 8) / (8 * np.pi), 2.5) * np.maximum(dot(normal, half), 0) ** power
    grazing = 1 - np.maximum(-dot(normal, ray), 0)
    mirror = 0.04 + (color - 0.04) * metallic
    mirror = mirror + (1 - mirror) * (np.square(np.square(grazing)) * grazing * (1 - roughness))
    matt = color * (1 - metallic) * (sun * _column(light.sun) + light.ambient * sky_light(light, normal[2]))
    return matt + mirror * (lobe * sun * _column(light.sun) + around * (metallic + light.ambient * (1 - metallic)))
