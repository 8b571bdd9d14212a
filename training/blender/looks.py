# SPDX-License-Identifier: MIT
"""Random materials, lights and skies, as plain numbers."""

from __future__ import annotations

import colorsys
import math
import random
from typing import Any

PROCEDURAL = ("checker", "noise", "brick", "voronoi", "wave", "magic")
PICTURES = ("text", "windows", "stripes")
CUTOUTS = ("leaves", "mesh")

WOVEN = ("checker", "checker", "checker", "wave", "wave", "voronoi", "noise", "brick", "stripes", "text", "plain")
"""Textures of the clean scenes whose surfaces are all pattern, with cells near the pixel's size."""
CELL = {"checker": 1.0, "wave": 0.3, "voronoi": 1.0, "noise": 2.0, "brick": 0.5}
"""Metres of a cell, or of a period, at scale 1."""
CELLS = 0.4, 5.0
"""The smallest and the largest cell in pixels at the middle of a woven scene."""


def colour(rng: random.Random, low: float = 0.05, high: float = 0.9, saturation: float = 0.8) -> list[float]:
    """A scene-linear colour: any hue, brightness between the two."""
    return list(colorsys.hsv_to_rgb(rng.random(), saturation * rng.random(), rng.uniform(low, high)))


def material(rng: random.Random, texture: str | None = None, metal: float = 0.2) -> dict[str, Any]:
    """A random material.

    Args:
        rng: where chance comes from.
        texture: its kind; None: any that is not a cut-out.
        metal: how likely it is one.
    """
    kind = texture or rng.choice(("plain", "plain", *PROCEDURAL, *PROCEDURAL, *PICTURES))
    is_metal = kind not in CUTOUTS and rng.random() < metal
    rough = rng.uniform(0.12, 0.5) if is_metal else rng.uniform(0.3, 1.0)
    made = {
        "texture": kind,
        "a": colour(rng, 0.4, 0.95),
        "b": colour(rng, 0.03, 0.4),
        "scale": math.exp(rng.uniform(math.log(0.5), math.log(4.5))) * (0.4 if kind == "brick" else 1.0),
        "metallic": [1.0, rng.choice((1.0, 1.0, 0.0))] if is_metal else [0.0, 0.0],
        "roughness": [rough, min(1.0, rough * rng.choice((1.0, 1.0, 1.8)))],
        "bump": rng.uniform(0.1, 0.6) if kind in PROCEDURAL and rng.random() < 0.35 else 0.0,
        # Without a gloss a surface needs one sample a light; with one it is noisier.
        "gloss": is_metal or (kind not in CUTOUTS and rng.random() < 0.35),
        "glow": 0.0,
        "seed": rng.randrange(2**31),
    }
    if kind == "leaves":
        made |= {"a": [rng.uniform(0.1, 0.5), rng.uniform(0.4, 0.8), rng.uniform(0.05, 0.2)], "b": [0.05, 0.12, 0.02]}
    if kind not in CUTOUTS and not is_metal and rng.random() < 0.06:
        made["glow"] = rng.uniform(0.4, 1.5)
    return made


def woven(rng: random.Random, texture: str, first: list[float], pixels: float) -> dict[str, Any]:
    """What is different in woven scenes: cells of `CELLS`, for so many ``pixels`` a metre; half of the patterns in shades of one colour."""
    made: dict[str, Any] = {}
    if texture in CELL:
        made["scale"] = CELL[texture] * pixels / math.exp(rng.uniform(*(math.log(cell) for cell in CELLS)))
    if rng.random() < 0.5:
        shade = rng.uniform(0.35, 0.85)
        made["b"] = [shade * channel for channel in first]
    return made


def sky(rng: random.Random, mood: str) -> dict[str, Any]:
    """What is behind everything: a gradient without a surface, or a dome with clouds that has depth and motion."""
    strength = {"day": 0.9, "dusk": 0.4, "night": 0.06}[mood]
    warm = [1.0, 0.55, 0.3] if mood == "dusk" else [0.85, 0.9, 1.0]
    return {
        "kind": rng.choice(("gradient", "dome")),
        "horizon": [strength * c for c in warm],
        "zenith": [strength * c for c in (0.25 * rng.uniform(0.5, 1.5), 0.45, 0.9)],
        "clouds": rng.uniform(1.5, 6.0),
        "lights": rng.random() < 0.12,
        "ambient": {"day": 0.3, "dusk": 0.2, "night": 0.08}[mood] * rng.uniform(0.7, 1.4),
        "seed": rng.randrange(2**31),
    }


def lights(rng: random.Random, mood: str, at: list[float], frames: int) -> list[dict[str, Any]]:
    """A sun, and lamps that move or stand; half of all suns move as well.

    Args:
        rng: where chance comes from.
        mood: "day", "dusk" or "night".
        at: the middle of the scene.
        frames: how many there are.
    """
    made: list[dict[str, Any]] = []
    made.append(
        {
            "kind": "sun",
            "turn": [rng.uniform(0.2, 1.1), 0.0, rng.uniform(0, 2 * math.pi)],
            "power": {"day": 3.0, "dusk": 1.6, "night": 0.15}[mood] * rng.uniform(0.7, 1.2),
            "colour": [1.0, rng.uniform(0.7, 1.0), rng.uniform(0.45, 1.0)] if mood != "night" else [0.6, 0.7, 1.0],
            "soft": rng.choice((0.0, 0.0, 0.01)),
            "rate": rng.choice((-1, 1)) * rng.uniform(0.005, 0.05) if rng.random() < 0.5 else 0.0,
        }
    )
    for _ in range({"day": rng.choice((0, 0, 1)), "dusk": rng.randint(1, 2), "night": rng.randint(2, 3)}[mood]):
        high, angle, away = rng.uniform(1.5, 5.0), rng.uniform(0, 2 * math.pi), rng.uniform(0.0, 5.0)
        motion = {
            "kind": "circle",
            "rate": rng.choice((-1, 1)) * rng.uniform(0.01, 0.12),
            "phase": angle,
            "radius": rng.uniform(0.5, 3),
        }
        moves = rng.random() < 0.7
        made.append(
            {
                "kind": "point",
                "at": [at[0] + away * math.cos(angle), at[1] + away * math.sin(angle), high],
                "power": 30 * (high + 1.5) ** 2 * rng.uniform(0.7, 1.5),
                "colour": colour(rng, 0.9, 1.0, 0.7),
                "soft": rng.choice((0.0, 0.0, 0.04)),
                "motion": motion if moves else None,
            }
        )
    return made
