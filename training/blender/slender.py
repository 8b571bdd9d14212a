# SPDX-License-Identifier: MIT
"""Things about a pixel wide: blades of grass, wires, poles."""

from __future__ import annotations

import math
from typing import Any

from level import across


def grass(scene: Any) -> None:
    """Tufts of blades a pixel wide or less; on a field many, else in every third scene. Woven ones: meadows of blades up to three wide."""
    rng, unit = scene.rng, scene.away / 9
    paints = [scene.paint("plain", 0) for _ in range(3)]
    for paint in paints:
        bright = rng.uniform(0.15, 0.8)
        green = [bright * rng.uniform(0.2, 0.8), bright, bright * rng.uniform(0.05, 0.4)]
        scene.materials[paint] |= {"a": green, "b": green}
    for _ in range(rng.randint(4, 10) if scene.layout == "field" or rng.random() < (0.8 if scene.woven else 0.33) else 0):
        wide, tall = unit * (rng.uniform(3, 10) if scene.woven else rng.uniform(1, 4)), unit * rng.uniform(0.2, 1)
        if spot := scene.spot(0 if scene.woven else wide / 3, 5 * unit):
            scene.put("grass", (*spot, tall / 2), (wide, wide, tall), rng.choice(paints), (0, 0, rng.uniform(0, 6)))


def wires(scene: Any) -> None:
    """Wires across the picture, in front of and behind the things there, in every second scene."""
    rng, unit = scene.rng, scene.away / 9
    for _ in range(rng.choice((1, 1, 2) if scene.woven else (0, 0, 1, 2))):
        angle = across(scene) if scene.level else rng.uniform(0, 2 * math.pi)
        far, tall = rng.uniform(-4, 4) * unit, unit * rng.uniform(0.5, 3)
        at = (
            scene.centre[0] + far * math.cos(angle),
            scene.centre[1] + far * math.sin(angle),
            unit * rng.uniform(0.3, 3) + tall / 2,
        )
        scene.put("wires", at, (12 * unit, unit, tall), scene.paint("plain", 0.3), (0, 0, angle + math.pi / 2))


def poles(scene: Any) -> None:
    """A row of poles, mostly a pixel or two wide, at most as far apart as they are high."""
    rng, unit = scene.rng, scene.away / 9
    width, tall = unit * math.exp(rng.uniform(math.log(0.03), math.log(0.2))), unit * rng.uniform(1.5, 4)
    width *= 0.6 if scene.level else 1
    angle = across(scene) if scene.level else rng.uniform(0, 2 * math.pi)
    far, step = rng.uniform(-3, 4) * unit, tall * rng.uniform(0.25, 1)
    paint = scene.paint("plain", 0.3)
    for i in range(-4, 5):
        x, y = far * math.cos(angle) - i * step * math.sin(angle), far * math.sin(angle) + i * step * math.cos(angle)
        if scene.free((scene.centre[0] + x, scene.centre[1] + y, 1.0), width):
            scene.put("cylinder", (scene.centre[0] + x, scene.centre[1] + y, tall / 2), (width, width, tall), paint)
