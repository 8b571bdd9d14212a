# SPDX-License-Identifier: MIT
"""Level scenes: the camera looks straight ahead at a wall, as a game's does. Edges and wires are then nearly level or upright.

A wire that climbs a pixel in fifty is a row of long dashes, and its steps lie farther apart than in any picture that looks down.
The wall ends the depth's range near what stands before it.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Any

from paths import Vector, add

FOV = 0.55, 0.95
"""Angles of view: a part of what games show, so that things are as large as in a wider frame; radians."""
SOLIDS = ("cube", "cube", "sphere", "cylinder", "cone", "torus", "torus", "monkey", "monkey", "letters")
"""What stands before the wall."""
WOVEN = ("checker", "checker", "checker", "checker", "wave", "wave", "voronoi", "noise", "brick", "stripes", "plain")
"""Its textures."""


def view(rng: random.Random, centre: Sequence[float], away: float, angle: float) -> tuple[Vector, Vector]:
    """The camera, and what it looks at, nearly as high as itself; from ``away`` metres, at ``angle`` about the vertical."""
    eye = add(centre, (math.cos(angle), math.sin(angle), rng.uniform(-0.03, 0.15)), away)
    aside = rng.uniform(-0.1, 0.1) * away
    target = (centre[0] - aside * math.sin(angle), centre[1] + aside * math.cos(angle), eye[2] + rng.gauss(0, 0.04) * away)
    return eye, target


def across(scene: Any) -> float:
    """The angle at which the first camera stands, or nearly so: what lies across is level in its picture."""
    eye = scene.walk[0]
    angle = math.atan2(eye[1] - scene.centre[1], eye[0] - scene.centre[0])
    return angle + scene.rng.gauss(0, scene.rng.choice((0.02, 0.02, 0.3)))


def shades(rng: random.Random, first: Sequence[float]) -> dict[str, Any]:
    """Colours of most patterns: a bright one and a shade of it."""
    if rng.random() < 0.3:
        return {}
    bright, shade = rng.uniform(0.5, 0.95) / max(first), rng.uniform(0.2, 0.6)
    light = [min(1.0, bright * channel) for channel in first]
    return {"a": light, "b": [shade * channel for channel in light]}


def wall(scene: Any) -> None:
    """A wall behind everything, with large squares, a pattern, or plain."""
    rng, unit, angle = scene.rng, scene.away / 9, across(scene)
    far, paint = rng.uniform(3, 9) * unit, scene.paint(rng.choice(("checker", "checker", "plain", None)))
    if scene.materials[paint]["texture"] == "checker":
        scene.materials[paint]["scale"] *= rng.uniform(0.1, 1)
    at = (scene.centre[0] - far * math.cos(angle), scene.centre[1] - far * math.sin(angle), 7 * unit)
    scene.put("cube", at, (60 * unit, 0.2 * unit, 14 * unit), paint, (0, 0, angle + math.pi / 2))


def words(scene: Any) -> None:
    """Lettering that faces the camera, on the ground and above it."""
    rng, unit = scene.rng, scene.away / 9
    for _ in range(rng.randint(2, 5)):
        if spot := scene.spot(unit, 4 * unit):
            size, facing = unit * rng.uniform(0.7, 3.0), across(scene) + math.pi / 2
            scene.put("letters", (*spot, unit * rng.uniform(0.0, 3.0)), [size] * 3, scene.paint("plain"), (0, 0, facing))
