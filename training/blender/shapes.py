# SPDX-License-Identifier: MIT
"""Meshes for which Blender has no primitive: things made of bars, and cards for foliage. Plain Python.

Everything lies within -0.5..0.5 in each coordinate, z up; the builder scales it to metres.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

Point = tuple[float, float, float]
Bar = tuple[Point, Point, float]
"""From, to, thickness."""


@dataclass
class Mesh:
    """Corners, faces as numbers of corners, and a texture coordinate for each corner of each face."""

    corners: list[Point] = field(default_factory=list)
    faces: list[tuple[int, ...]] = field(default_factory=list)
    uv: list[tuple[float, float]] = field(default_factory=list)

    def quad(self, points: Sequence[Point]) -> None:
        """Add a square that shows the whole texture."""
        first = len(self.corners)
        self.corners += points
        self.faces.append(tuple(range(first, first + 4)))
        self.uv += [(0, 0), (1, 0), (1, 1), (0, 1)]

    def bar(self, bar: Bar) -> None:
        """Add a bar of square section."""
        (a, b, thick) = bar
        d = [b[i] - a[i] for i in range(3)]
        length = math.sqrt(sum(x * x for x in d))
        up = (0.0, 0.0, 1.0) if abs(d[2]) < 0.9 * length else (1.0, 0.0, 0.0)
        u = _unit(_cross(d, up))
        v = _unit(_cross(d, u))
        sides = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
        ring = [[tuple(end[i] + 0.5 * thick * (p * u[i] + q * v[i]) for i in range(3)) for p, q in sides] for end in (a, b)]
        for i in range(4):
            j = (i + 1) % 4
            self.quad([ring[0][i], ring[0][j], ring[1][j], ring[1][i]])


def _cross(a: Sequence[float], b: Sequence[float]) -> Point:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _unit(a: Sequence[float]) -> Point:
    length = math.sqrt(sum(x * x for x in a))
    return (a[0] / length, a[1] / length, a[2] / length)


def mesh(kind: str, seed: int) -> Mesh:
    """Make a mesh.

    Args:
        kind: "fence", "lattice", "wheel", "cables", "wires", "ladder", "card", "bush" or "grass".
        seed: for its random parts.
    """
    rng = random.Random(f"shape {kind} {seed}")
    made = Mesh()
    if kind == "card":
        made.quad([(-0.5, 0, -0.5), (0.5, 0, -0.5), (0.5, 0, 0.5), (-0.5, 0, 0.5)])
    elif kind == "bush":
        for _ in range(rng.randint(3, 7)):
            angle = rng.uniform(0, math.pi)
            c, s, o = 0.5 * math.cos(angle), 0.5 * math.sin(angle), rng.uniform(-0.1, 0.1)
            made.quad([(-c + o, -s, -0.5), (c + o, s, -0.5), (c + o, s, 0.5), (-c + o, -s, 0.5)])
    elif kind == "grass":
        for _ in range(rng.randint(60, 200)):
            made.quad(_blade(rng))
    else:
        for bar in BARS[kind](rng):
            made.bar(bar)
    return made


def _blade(rng: random.Random) -> list[Point]:
    """A blade of grass: a thin triangle, bent over; a square whose upper corners meet."""
    x, y, angle = rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(0, 2 * math.pi)
    half, lean, tall = rng.uniform(0.002, 0.008), rng.gauss(0, 0.04), rng.uniform(0.1, 1.0)
    c, s = math.cos(angle), math.sin(angle)
    tip = (x - lean * s, y + lean * c, tall - 0.5)
    return [(x - half * c, y - half * s, -0.5), (x + half * c, y + half * s, -0.5), tip, tip]


def _fence(rng: random.Random) -> list[Bar]:
    n, thick = rng.randint(8, 24), rng.uniform(0.006, 0.02)
    posts: list[Bar] = [((i / n - 0.5, 0, -0.5), (i / n - 0.5, 0, rng.uniform(0.42, 0.5)), thick) for i in range(n + 1)]
    return [*posts, ((-0.5, 0, 0.3), (0.5, 0, 0.3), 1.3 * thick), ((-0.5, 0, -0.3), (0.5, 0, -0.3), 1.3 * thick)]


def _lattice(rng: random.Random) -> list[Bar]:
    n, thick = rng.randint(2, 5), rng.uniform(0.01, 0.03)
    at = [i / n - 0.5 for i in range(n + 1)]
    bars: list[Bar] = []
    for a in at:
        for b in at:
            bars += [((-0.5, a, b), (0.5, a, b), thick), ((a, -0.5, b), (a, 0.5, b), thick), ((a, b, -0.5), (a, b, 0.5), thick)]
    return bars


def _wheel(rng: random.Random) -> list[Bar]:
    n, thick = rng.randint(6, 16), rng.uniform(0.012, 0.03)
    rim = [(0.5 * math.cos(2 * math.pi * i / 24), 0.0, 0.5 * math.sin(2 * math.pi * i / 24)) for i in range(24)]
    spokes = [(0.5 * math.cos(2 * math.pi * i / n), 0.0, 0.5 * math.sin(2 * math.pi * i / n)) for i in range(n)]
    bars: list[Bar] = [(rim[i], rim[(i + 1) % 24], 2 * thick) for i in range(24)]
    return bars + [((0.0, 0.0, 0.0), spoke, thick) for spoke in spokes]


def _cables(rng: random.Random) -> list[Bar]:
    """Hanging wires in short pieces, some only a twentieth of a pixel thick."""
    bars: list[Bar] = []
    for _ in range(rng.randint(3, 8)):
        y, z, sag = rng.uniform(-0.5, 0.5), rng.uniform(0.1, 0.5), rng.uniform(0.1, 0.5)
        thick = rng.uniform(0.002, 0.008)
        curve: list[Point] = [(i / 12 - 0.5, y, z - sag * (1 - (i / 6 - 1) ** 2)) for i in range(13)]
        bars += [(curve[i], curve[i + 1], thick) for i in range(12)]
    return bars


def _wires(rng: random.Random) -> list[Bar]:
    """Taut wires, one above the other, from a twentieth of a pixel to a pixel thick."""
    n, thick = rng.randint(2, 7), math.exp(rng.uniform(math.log(0.0008), math.log(0.006)))
    return [
        ((-0.5, 0.0, z), (0.5, rng.uniform(-0.1, 0.1), z + rng.gauss(0, 0.02)), thick) for z in (i / n - 0.4 for i in range(n))
    ]


def _ladder(rng: random.Random) -> list[Bar]:
    n, thick = rng.randint(6, 14), rng.uniform(0.015, 0.035)
    bars: list[Bar] = [((x, 0.0, -0.5), (x, 0.0, 0.5), thick) for x in (-0.2, 0.2)]
    return bars + [((-0.2, 0.0, (i + 0.5) / n - 0.5), (0.2, 0.0, (i + 0.5) / n - 0.5), 0.7 * thick) for i in range(n)]


BARS: dict[str, Callable[[random.Random], list[Bar]]] = {
    "fence": _fence, "lattice": _lattice, "wheel": _wheel, "cables": _cables, "wires": _wires, "ladder": _ladder,
}  # fmt: skip
"""Kinds of mesh that are made of bars."""
