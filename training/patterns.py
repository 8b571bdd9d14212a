# SPDX-License-Identifier: MIT
"""Patterns, drawn from a seed, with detail that the conformance scenes lack: text, and grain at every scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from conformance.scenes.materials import Finish, Material, Pattern, bricks, checker, noise, rings, sectors, stripes
from stss_ref.arrays import Array

Random = np.random.Generator
_TABLE = 64
FINEST = 5.0
"""Shortest period of a pattern; cm. At 5 m, a pixel of a frame of 160 is about 4 cm wide: finer detail is noise that no network can
remove."""
EYE = (0.0, -420.0, 140.0)
"""Approximate place of the cameras; cm."""
PIXEL = 0.0075
"""Approximate width of a pixel at distance 1, in a frame of 160."""


def glyphs(cell: float, random: Random) -> Pattern:
    """Rows of letter-like marks of 5 x 7 cells of ``cell`` cm, with gaps between the letters, words and lines."""
    table = random.random((_TABLE, _TABLE)) < random.uniform(0.4, 0.6)
    table[:, ::6] = False
    table[::9] = table[1::9] = False
    for line in range(0, _TABLE, 9):
        start = 6 * int(random.integers(2, 9))
        table[line : line + 9, start : start + 6] = False

    def pattern(point: Array) -> Array:
        u, v = _unfold(point)
        return table[_wrap(np.floor(-v / cell)), _wrap(np.floor(u / cell))].astype(point.dtype)

    return pattern


def grain(scale: float, random: Random, *, octaves: int = 3, sharp: bool = False) -> Pattern:
    """Value noise, each octave half as wide and half as strong as the one before; ``sharp`` cuts it into two tones."""
    table = random.random((_TABLE, _TABLE))
    offsets = random.uniform(0, _TABLE, (octaves, 2))

    def pattern(point: Array) -> Array:
        u, v = _unfold(point)
        total, strength = np.zeros_like(u), 1.0
        for i in range(octaves):
            size = scale / 2**i
            total += strength * _lookup(table, u / size + offsets[i, 0], v / size + offsets[i, 1])
            strength *= 0.5
        value = np.clip((total / (2 - 2 * strength) - 0.5) * 2 + 0.5, 0, 1)
        return (value > 0.5).astype(point.dtype) if sharp else value

    return pattern


def filter_by_period(material: Material, period: float) -> Material:
    """The material of a large flat floor: its pattern fades to the mean where ``period`` is below a few pixels, as with mip maps."""

    def fade(pattern: Pattern) -> Pattern:
        def faded(point: Array) -> Array:
            square = (point[0] - EYE[0]) ** 2 + (point[1] - EYE[1]) ** 2
            pixel = PIXEL * square / EYE[2]  # the length that a pixel covers at a grazing angle
            return 0.5 + (pattern(point) - 0.5) * np.clip(1.5 - pixel / (0.5 * period), 0, 1)

        return faded

    pattern, wear = (None if p is None else fade(p) for p in (material.pattern, material.wear))
    return replace(material, pattern=pattern, wear=wear)


def random_material(random: Random, size: float, *, plain: float = 0.2) -> Material:
    """A material for an object about ``size`` cm large; with the probability ``plain``, without a pattern."""
    first, second = _finish(random), _finish(random)
    if random.random() < plain:
        return Material(first)
    wear = grain(size * random.uniform(0.1, 1), random) if random.random() < 0.5 else None
    return Material(first, second, _pattern(random, size), wear, depth=float(random.uniform(0.1, 0.6)))


def _pattern(random: Random, size: float) -> Pattern:
    # Log-uniform: from about a pixel to a few patches on the whole object.
    period = max(FINEST, float(size * np.exp(random.uniform(np.log(0.06), np.log(0.7)))))
    axes = (0, 1, 2) if random.random() < 0.5 else (0, 2)
    choices = (
        lambda: checker(period, axes=axes),
        lambda: checker(period, axes=axes),
        lambda: checker(period),
        lambda: stripes(period, axis=int(random.integers(3)), share=float(random.uniform(0.1, 0.6))),
        lambda: bricks(period * 2, period * 0.8, period * 0.15),
        lambda: rings(period, axes=(0, 2) if random.random() < 0.5 else (0, 1)),
        lambda: sectors(2 * int(random.integers(2, 12))),
        lambda: noise(period),
        lambda: glyphs(max(FINEST / 2, period * 0.2), random),
        lambda: glyphs(max(FINEST / 2, period * 0.1), random),
        lambda: grain(period, random),
        lambda: grain(period, random, sharp=True),
    )
    return choices[int(random.integers(len(choices)))]()


def _finish(random: Random) -> Finish:
    grey = random.random() < 0.3
    color = np.repeat(random.random(), 3) if grey else random.random(3)
    color = 0.03 + 0.94 * color ** random.uniform(0.7, 2)
    metallic = 1.0 if random.random() < 0.12 else 0.0
    return Finish((float(color[0]), float(color[1]), float(color[2])), float(random.uniform(0.08, 1)), metallic)


def _unfold(point: Array) -> tuple[Array, Array]:
    # Sheared, since a face of a box would otherwise have the same value all along one of its sides.
    return point[0] + 0.43 * point[1], point[2] + 0.71 * point[1]


def _wrap(index: Array) -> np.ndarray:
    return index.astype(np.int64) % _TABLE


def _lookup(table: Array, u: Array, v: Array) -> Array:
    x, y = np.floor(u), np.floor(v)
    fx, fy = u - x, v - y
    x0, y0 = _wrap(x), _wrap(y)
    x1, y1 = (x0 + 1) % _TABLE, (y0 + 1) % _TABLE
    top = table[y0, x0] + (table[y0, x1] - table[y0, x0]) * fx
    bottom = table[y1, x0] + (table[y1, x1] - table[y1, x0]) * fx
    return top + (bottom - top) * fy
