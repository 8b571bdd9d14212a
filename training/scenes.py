# SPDX-License-Identifier: MIT
"""Random analytic scenes: a scene is drawn from its number alone, so the same number gives the same film."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from conformance.scenes import Camera, Light, Object, Scene
from conformance.scenes.scene import Pose, Vector
from conformance.scenes.shapes import Box, Cylinder, Disc, Plane, Shape, Sphere
from training.patterns import Random, filter_by_period, random_material

CAMERAS = ("still", "pan", "tilt", "dolly", "dolly", "forward", "orbit", "shake", "cut")
INPUTS = {"aliased": (), "color": ("color",), "all": ("color", "normal", "nov", "base_color", "roughness", "metallic")}
"""Buffers that are means over the pixel: in an engine without antialiasing, in one with it, in a path tracer that averages all."""
LENGTH = 12
"""Number of useful frames of a film: paths are centred on the middle one."""


@dataclass(frozen=True)
class Film:
    """A scene whose light may change.

    Attributes:
        scene: at frame 0.
        light: the light at a frame.
        averaged: buffers that are means over the low-resolution pixel; others have the value of the ray through its centre.
    """

    scene: Scene
    light: Callable[[float], Light]
    averaged: tuple[str, ...] = ()

    def at(self, frame: float) -> Scene:
        """The scene to render for ``frame``; the scenes of two frames differ only in their light."""
        return replace(self.scene, light=self.light(frame))


def random_film(seed: int, inputs: str = "aliased") -> Film:
    """The film number ``seed``; ``inputs``: a name of `INPUTS`."""
    random = np.random.default_rng([seed, 20240711])
    objects = _surroundings(random)
    objects += [_thing(random, f"thing {i}", path=False) for i in range(int(random.integers(4, 10)))]
    objects += _thin(random)
    objects += [_thing(random, f"moving {i}", path=True) for i in range(int(random.integers(0, 4)))]
    scene = Scene(f"analytic-{seed:05d}", _camera(random, str(random.choice(CAMERAS))), tuple(objects))
    return Film(scene, _light(random), INPUTS[inputs])


def _surroundings(random: Random) -> list[Object]:
    floor = random_material(random, 300, plain=0.05)
    # As with mip maps, or without.
    ground = Object("ground", Plane(), filter_by_period(floor, 50) if random.random() < 0.6 else floor, casts=False)
    kind = random.random()
    if kind < 0.35:  # a room
        half = (float(random.uniform(500, 900)), float(random.uniform(700, 1000)), float(random.uniform(250, 500)))
        return [ground, Object("room", Box(half), random_material(random, 300, plain=0.1), at=(0, 0, half[2] - 1), casts=False)]
    walls = [
        Object(f"wall {i}", Box(half), random_material(random, 300, plain=0.1), at=at, yaw=float(random.normal(0, 0.1)))
        for i, (half, at) in enumerate(
            (
                ((float(random.uniform(200, 2000)), 20, float(random.uniform(60, 300))), (float(random.normal(0, 200)), 600, 60)),
                ((20, float(random.uniform(200, 900)), float(random.uniform(60, 300))), (-500, float(random.normal(0, 200)), 60)),
            )
        )
    ]
    return [ground, *(wall for wall in walls if random.random() < 0.8)]


def _thing(random: Random, name: str, *, path: bool) -> Object:
    size = float(np.exp(random.uniform(np.log(18), np.log(130))))
    shape = _shape(random, size)
    ground = shape.half[2] if isinstance(shape, Box) else shape.half_height if isinstance(shape, Cylinder) else size
    at = (float(random.normal(0, 170)), float(random.uniform(-220, 300)), float(ground))
    if random.random() < 0.25:
        at = (at[0], at[1], at[2] + float(random.uniform(0, 150)))
    yaw = float(random.uniform(0, 2 * math.pi))
    material = random_material(random, size)
    if not path:
        return Object(name, shape, material, at=at, yaw=yaw)
    return Object(name, shape, material, path=_path(random, at, yaw))


def _shape(random: Random, size: float) -> Shape:
    kind = int(random.integers(5))
    if kind == 0:
        return Sphere(size)
    if kind == 1:
        return Cylinder(size * float(random.uniform(0.1, 0.6)), size)
    if kind == 2:
        return Disc(size)
    x, y, z = (float(v) for v in size * random.uniform(0.15, 1, 3))
    return Box((x, y, z))


def _thin(random: Random) -> list[Object]:
    """Poles, rails and wires about a pixel wide or less; the background behind them changes as the camera moves."""
    things: list[Object] = []
    for group in range(int(random.integers(1, 5))):
        material = random_material(random, 40, plain=0.6)
        x, y, step = random.uniform(-300, 100), random.uniform(-350, 200), random.uniform(15, 90)
        thickness = float(np.exp(random.uniform(np.log(0.3), np.log(4))))
        upright = random.random() < 0.6
        for i in range(int(random.integers(2, 7))):
            if upright:
                height = 40 + 10 * group + float(random.uniform(0, 80))
                shape: Shape = Cylinder(thickness, height)
                at = (float(x + i * step), float(y + i * random.uniform(-10, 10)), height)
            else:
                shape = Box((float(random.uniform(60, 260)), thickness, thickness))
                at = (float(x + 150), float(y), 20.0 + i * float(step) * 0.5)
            things.append(
                Object(f"thin {group}.{i}", shape, material, at=at, yaw=0.0 if upright else float(random.normal(0, 0.3)))
            )
    return things


def _speed(random: Random, slow: float, fast: float) -> float:
    return float(np.exp(random.uniform(np.log(slow), np.log(fast)))) * (1 if random.random() < 0.5 else -1)


def _path(random: Random, at: Vector, yaw: float) -> Callable[[float], Pose]:
    """A straight path that sways sideways and turns; cm and radians a frame."""
    heading, speed = random.uniform(0, 2 * math.pi), _speed(random, 0.5, 25)
    step = speed * math.cos(heading), speed * math.sin(heading), float(random.normal(0, 1))
    turn = float(random.normal(0, 0.05)) if random.random() < 0.6 else 0.0
    reach, period = float(random.uniform(0, 15)), float(random.uniform(12, 60))

    def path(frame: float) -> Pose:
        t, s = frame - LENGTH / 2, reach * math.sin(2 * math.pi * frame / period)
        return (at[0] + step[0] * t, at[1] + step[1] * t, at[2] + step[2] * t + s), yaw + turn * frame

    return path


def _camera(random: Random, kind: str) -> Camera:
    eye = float(random.uniform(-150, 150)), -float(random.uniform(300, 520)), float(random.uniform(60, 220))
    target = float(random.uniform(-120, 120)), float(random.uniform(-50, 150)), float(random.uniform(30, 140))
    spread = float(random.uniform(0.35, 0.8))
    if kind == "cut":
        before, after = (_camera(random, str(random.choice(["dolly", "pan", "still"]))) for _ in range(2))
        when = int(random.integers(3, 9))
        return Camera(
            lambda f: (before if f < when else after).position(f), lambda f: (before if f < when else after).target(f), spread
        )
    offset_eye, offset_target = _MOVES[kind](random)
    return Camera(lambda f: _add(eye, offset_eye(f - LENGTH / 2)), lambda f: _add(target, offset_target(f - LENGTH / 2)), spread)


def _add(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


Offset = Callable[[float], Vector]
Offsets = tuple[Offset, Offset]


def _fixed(time: float) -> Vector:
    return 0.0, 0.0, 0.0


def _pan(random: Random) -> Offsets:
    v = _speed(random, 1, 40)
    return _fixed, lambda t: (v * t, 0.0, 0.0)


def _tilt(random: Random) -> Offsets:
    v = _speed(random, 1, 15)
    return _fixed, lambda t: (0.3 * v * t, 0.0, v * t)


def _dolly(random: Random) -> Offsets:
    v, lift, relative = _speed(random, 0.3, 16), float(random.normal(0, 1)), float(random.uniform(0, 1.6))
    return lambda t: (v * t, 0.2 * v * t, lift * t), lambda t: (relative * v * t, 0.0, 0.0)


def _forward(random: Random) -> Offsets:
    v, drift = _speed(random, 2, 20), float(random.normal(0, 2))
    return lambda t: (drift * t, v * t, 0.0), lambda t: (drift * t, max(v * t, 0.0), 0.0)


def _orbit(random: Random) -> Offsets:
    rate = _speed(random, 0.002, 0.03)
    return lambda t: (450 * math.sin(rate * t), 450 * (1 - math.cos(rate * t)), 0.0), _fixed


def _shake(random: Random) -> Offsets:
    rates, phases, reach = random.uniform(0.3, 2.5, 3), random.uniform(0, 6, 3), random.uniform(0.5, 8)
    drift = _speed(random, 0.3, 6)

    def jitter(t: float) -> Vector:
        x, y, z = (float(v) for v in reach * np.sin(rates * t + phases))
        return drift * t + x, y, z

    return lambda t: (drift * t, 0.0, 0.0), jitter


_MOVES: dict[str, Callable[[Random], Offsets]] = {
    "still": lambda random: (_fixed, _fixed),
    "pan": _pan, "tilt": _tilt, "dolly": _dolly, "forward": _forward, "orbit": _orbit, "shake": _shake,
}  # fmt: skip


def _light(random: Random) -> Callable[[float], Light]:
    azimuth, height = float(random.uniform(0, 2 * math.pi)), float(random.uniform(0.25, 1.5))
    warm = random.uniform(0.6, 1.1, 3) * random.uniform(0.3, 1.15)
    zenith, horizon, ground = random.uniform(0.05, 0.8, 3), random.uniform(0.2, 0.95, 3), random.uniform(0.05, 0.4, 3)
    ambient = float(random.uniform(0.2, 0.7))
    # The G-buffer does not show shadows that move and light that flickers.
    turn = float(random.normal(0, 0.02)) if random.random() < 0.3 else 0.0
    flicker = float(random.uniform(0.02, 0.15)) if random.random() < 0.15 else 0.0

    def light(frame: float) -> Light:
        a, strength = azimuth + turn * frame, 1 + flicker * math.sin(0.7 * frame)
        sun = tuple(float(v) for v in warm * strength)
        colors = [tuple(float(v) for v in c) for c in (zenith, horizon, ground)]
        return Light((math.cos(a), math.sin(a), height), sun, colors[0], colors[1], colors[2], ambient)  # type: ignore[arg-type]

    return light
