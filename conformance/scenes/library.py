# SPDX-License-Identifier: MIT
"""The scenes. A frame is 1/60 s; one low-resolution pixel at 160 x 90 is about 4 cm at 5.5 m."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from conformance.scenes.materials import Finish, Material, bricks, checker, noise, rings, sectors, stripes
from conformance.scenes.scene import Camera, Light, Object, Pose, Scene, Vector
from conformance.scenes.shapes import Box, Cylinder, Disc, Plane, Sphere

_TILES = Material(Finish((0.78, 0.72, 0.62), 0.45), Finish((0.2, 0.3, 0.34), 0.35), checker(50), wear=noise(70), depth=0.25)
_GRASS = Material(Finish((0.3, 0.38, 0.16), 0.9), Finish((0.46, 0.44, 0.22), 0.9), noise(260))
_HEDGE = Material(Finish((0.1, 0.2, 0.07), 0.95), Finish((0.26, 0.38, 0.14), 0.95), noise(55), noise(170), depth=0.5)
_BRICK = Material(Finish((0.58, 0.27, 0.18), 0.8), Finish((0.74, 0.7, 0.64), 0.9), bricks(64, 22, 4.5), noise(60))
_PLASTER = Material(Finish((0.82, 0.76, 0.62), 0.8), Finish((0.3, 0.45, 0.5), 0.6), stripes(34, axis=1), noise(90))
_TARGET = Material(Finish((0.9, 0.88, 0.82), 0.6), Finish((0.75, 0.12, 0.1), 0.6), rings(18))
_BARBER = Material(Finish((0.9, 0.9, 0.88), 0.4), Finish((0.72, 0.1, 0.1), 0.4), stripes(30, axis=2))
_STEEL = Material(Finish((0.72, 0.74, 0.78), 0.4, 1.0))
_GOLD = Material(Finish((0.95, 0.72, 0.35), 0.12, 1.0))
_BALL = Material(Finish((0.93, 0.91, 0.85), 0.3), Finish((0.08, 0.28, 0.72), 0.3), sectors(8))
_RUBBER = Material(Finish((0.9, 0.42, 0.08), 0.5), Finish((0.16, 0.12, 0.1), 0.6), stripes(16, axis=2, share=0.25))
_CRATE = Material(Finish((0.16, 0.5, 0.36), 0.5), Finish((0.92, 0.84, 0.5), 0.5), checker(17.6, axes=(0, 1, 2)))
_MARBLE = Material(Finish((0.86, 0.85, 0.83), 0.3), Finish((0.5, 0.5, 0.54), 0.3), noise(14))
_BOARD = Material(Finish((0.16, 0.18, 0.22), 0.8), Finish((0.75, 0.78, 0.8), 0.8), bricks(14, 5, 1.2))
_BAR = Material(_RUBBER.first, _RUBBER.second, stripes(7, axis=0))


def _still(at: Vector) -> Callable[[float], Vector]:
    return lambda frame: at


def _line(start: Vector, step: Vector) -> Callable[[float], Vector]:
    """A point that moves by ``step`` cm a frame."""

    def path(frame: float) -> Vector:
        return start[0] + step[0] * frame, start[1] + step[1] * frame, start[2] + step[2] * frame

    return path


def _sway(centre: Vector, reach: Vector, period: float, turn: float = 0.0) -> Callable[[float], Pose]:
    """Back and forth through ``centre``, ``period`` frames a cycle, turning by ``turn`` radians a frame."""

    def path(frame: float) -> Pose:
        s = math.sin(2 * math.pi * frame / period)
        return (centre[0] + reach[0] * s, centre[1] + reach[1] * s, centre[2] + reach[2] * s), turn * frame

    return path


_GROUND = (
    Object("grass", Plane(), _GRASS, at=(0, 0, -6), casts=False),
    Object("hedge", Box((2600, 40, 110)), _HEDGE, at=(0, 1600, 104), casts=False),  # keeps the horizon, and depth, near
    Object("left hedge", Box((40, 1300, 110)), _HEDGE, at=(-1700, 300, 104), casts=False),
    Object("terrace", Box((520, 420, 3)), _TILES, at=(0, 60, -3), casts=False),
)
_BUILDING = (
    Object("wall", Box((250, 12, 125)), _BRICK, at=(-270, 330, 125)),
    Object("parapet", Box((260, 10, 30)), _PLASTER, at=(240, 400, 30), yaw=0.0),
    Object("side wall", Box((12, 240, 110)), _PLASTER, at=(-440, 100, 110)),
    Object("target", Disc(62), _TARGET, at=(-120, 316, 135)),
)
_POLES = tuple(
    Object(f"pole {i}", Cylinder(1.9, 125), _BARBER if i % 2 else _STEEL, at=(x, y, 125))
    for i, (x, y) in enumerate(((-190, 60), (60, -60), (150, 130), (235, 20)))
)
_COLUMN = (Object("column", Cylinder(24, 95), _MARBLE, at=(290, 220, 95)),)
_MOVING = (
    Object("ball", Sphere(38), _BALL, path=_sway((-20, -110, 38), (190, 20, 0), 120, turn=0.05)),
    Object("hopper", Sphere(24), _RUBBER, path=_sway((150, -20, 92), (30, 0, 60), 50, turn=-0.04)),
    Object("crate", Box((35, 35, 35)), _CRATE, path=_sway((-40, 200, 60), (-170, 0, 0), 140, turn=0.03)),
)
_METAL = (Object("gold", Sphere(58), _GOLD, at=(-255, 110, 58)),)

_QUIET = (*_GROUND, *_BUILDING, *_COLUMN, *_POLES, *_METAL)
_GARDEN = (*_QUIET, *_MOVING)

_TRIPOD = Camera(_still((-40, -520, 155)), _still((-10, 0, 100)))
_DOLLY = Camera(_line((-75, -520, 150), (3.2, 1.2, 0.25)), _line((-40, 0, 98), (4.2, 0, 0.1)))
_FORWARD = Camera(_line((0, -560, 150), (1, 14, -1)), _line((0, 400, 100), (4, 14, 0)))
_FROM_THE_RIGHT = Camera(_line((330, -430, 120), (-2, 0, 0)), _line((-110, 150, 90), (2, 0, 0)))


def _cut(before: Camera, after: Camera, frame: int) -> Camera:
    """``before`` up to the frame before ``frame``, ``after`` from it on."""

    def choose(time: float) -> Camera:
        return before if time < frame else after

    return Camera(lambda time: choose(time).position(time), lambda time: choose(time).target(time))


BLINK = 32
"""Frames for which the cursor of ``interface`` is there, and then as many for which it is not: about half a second each."""


def _blinking(at: Vector) -> Callable[[float], Pose]:
    """A place that is left for one under the ground every ``BLINK`` frames, from frame 8 on."""

    def path(frame: float) -> Pose:
        is_lit = math.floor((frame - 8) / BLINK) % 2 == 0
        return (at if is_lit else (at[0], at[1], -500.0)), 0.0

    return path


_LARGE = Object("globe", Sphere(68), _BALL, path=_sway((10, -90, 70), (90, 0, 0), 150, turn=0.02), casts=False)
_PANEL = (
    Object("panel", Box((60, 1, 40)), _BOARD, at=(-20, -330, 130), casts=False),
    Object("cursor", Box((2.2, 1, 7)), _BAR, path=_blinking((25, -334, 140)), casts=False),
)
_OVERCAST = replace(Light(), horizon=(0.62, 0.7, 0.82), overcast=True)
_LOOK_UP = Camera(_line((-60, -520, 150), (4, 0, 0)), _line((-60, 0, 157), (4, 0, 0)))

DEMO = Scene("demo", _DOLLY, _GARDEN)
SCENES = {
    scene.name: scene
    for scene in (
        DEMO,
        Scene("static", _TRIPOD, _QUIET),  # nothing moves
        Scene("object", _TRIPOD, (*_QUIET, _LARGE)),  # a still camera; a tenth of the pixels move
        Scene("interface", _TRIPOD, (*_QUIET, *_PANEL)),  # a still image but for a blinking cursor
        Scene("sky", _LOOK_UP, _GARDEN, _OVERCAST),  # the camera moves; two fifths are a sky of one colour
        Scene("pan", replace(_TRIPOD, target=_line((-120, 0, 100), (9, 0, 0))), _QUIET),  # the camera only turns
        Scene(
            "slow-pan", replace(_TRIPOD, target=_line((-20, 0, 100), (0.9, 0, 0))), _QUIET
        ),  # about half a pixel of 320 a frame
        Scene("flythrough", _FORWARD, _GARDEN),  # straight ahead, past the poles
        Scene("cut", _cut(_DOLLY, _FROM_THE_RIGHT, 8), _GARDEN),  # another camera from frame 8
    )
}
