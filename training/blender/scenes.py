# SPDX-License-Identifier: MIT
"""A random scene from a seed, as plain data: the same seed and split give the same scene everywhere.

Needs no Blender, so that the content of a set can be described and tested without rendering it.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
from collections.abc import Iterator
from itertools import count
from typing import Any

import level
import slender
from looks import CUTOUTS, PICTURES, WOVEN, lights, material, sky, woven
from paths import add, camera, distance

VERSION = 10
"""Raise it when the same seed no longer gives the same scene."""

SPLITS = ("train", "validation", "test")
LAYOUTS = ("hall", "street", "field", "table", "yard")
SOLIDS = ("cube", "cube", "sphere", "cylinder", "cone", "torus", "monkey")
THIN = ("fence", "lattice", "wheel", "cables", "wires", "ladder")
MOVES = ("orbit", "pan", "truck", "dolly", "crane", "tilt", "rest")
CLEAN = ("checker", "checker", "checker", "plain", "brick", "stripes")
"""Textures of clean scenes, which have only hard edges: flat surfaces in hard sunlight, no bumps, nothing that glows or mirrors."""
ROUND = 8
"""Of so many scenes of a set one is for validation and one for the test."""
KINDS = ("any", "clean", "woven", "level")
"""What a set may hold: every scene, those with exact light, of these those that patterns near the pixel's size cover, and of these those
seen by a level camera before a wall."""
WIDTH = 160
"""Speeds are drawn in pixels of a frame of this width; pixels."""

Thing = dict[str, Any]


class Scene:
    """A scene while it is made: the things in it, and their places."""

    def __init__(self, seed: int, split: str, frames: int):
        if split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, got {split!r}")
        # The split is part of the seed, so no scene of one split can be in another.
        self.rng = random.Random(f"stss blender {VERSION} {split} {seed}")
        rng = self.rng
        self.seed, self.split, self.frames = seed, split, frames
        self.layout, self.mood = rng.choice(LAYOUTS), rng.choice(("day", "day", "day", "dusk", "night"))
        self.clean = rng.random() < 0.6
        if self.clean:
            self.mood = "day"
        self.woven = self.clean and rng.random() < 0.75
        self.level = self.woven and rng.random() < 0.5
        if self.level:
            self.layout = rng.choice(("field", "street"))
        self.fov = rng.uniform(*level.FOV) if self.level else rng.uniform(0.7, 1.2)
        self.materials: list[Thing] = []
        self.objects: list[Thing] = []
        self.moving = 0
        self.centre = [0.0, 0.0, 0.4 if self.layout == "table" else 1.2]
        self.away = rng.uniform(3.5, 5.0) if self.layout == "table" else rng.uniform(7.0, 12.0)
        self.shots = self._shots()
        self.walk = [camera(self.shots, t)[0] for t in range(-1, frames + 1)]

    @property
    def focal(self) -> float:
        """Pixels per radian in the middle of a frame of width WIDTH."""
        return 0.5 * WIDTH / math.tan(0.5 * self.fov)

    def speed(self) -> float:
        """Draw a speed, pixels a frame: mostly slow, sometimes fast; not in level scenes."""
        if self.level:
            return self.rng.choice((self.rng.uniform(0.1, 1), self.rng.uniform(0.5, 2), self.rng.uniform(1, 3)))
        return self.rng.choice((self.rng.uniform(0.2, 1), self.rng.uniform(1, 3), self.rng.uniform(1, 3), self.rng.uniform(3, 7)))

    def _shots(self) -> list[Thing]:
        """One shot, or two with a cut between."""
        rng, shots = self.rng, []
        cuts = [0, rng.randint(self.frames // 3, 2 * self.frames // 3)] if rng.random() < 0.25 and self.frames >= 8 else [0]
        for first in cuts:
            angle, low = rng.uniform(0, 2 * math.pi), rng.uniform(0.08, 0.5)
            eye = add(self.centre, (math.cos(angle) * math.cos(low), math.sin(angle) * math.cos(low), math.sin(low)), self.away)
            move = rng.choice(MOVES)
            # Radians a frame, or metres a frame if the camera itself moves, so that nearer things pass by faster.
            rate = rng.choice((-1, 1)) * self.speed() / self.focal * (self.away if move in ("truck", "dolly", "crane") else 1)
            shake = rng.choice((0, 0, 0, rng.uniform(0.3, 1), rng.uniform(1, 4))) / self.focal
            target = add(self.centre, [rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(-0.3, 0.3)], 0.12 * self.away)
            if self.level:
                eye, target = level.view(rng, self.centre, self.away, angle)
            shot = {"first": first, "move": move, "eye": eye, "target": target}
            shots.append(shot | {"rate": rate, "shake": shake, "phase": rng.uniform(0, 6)})
        return shots

    def paint(self, texture: str | None = None, metal: float = 0.2) -> int:
        """A new material; its number."""
        textures = level.WOVEN if self.level else WOVEN if self.woven else CLEAN
        made = material(self.rng, texture or (self.rng.choice(textures) if self.clean else None), metal)
        if self.clean:
            made |= {"bump": 0.0, "glow": 0.0, "gloss": False, "metallic": [0.0, 0.0]}
        made["scale"] *= 9 / self.away
        if self.woven and texture is None:
            made |= woven(self.rng, made["texture"], made["a"], self.focal / self.away)
            if self.level:
                made |= level.shades(self.rng, made["a"])
        self.materials.append(made)
        return len(self.materials) - 1

    def put(self, shape: str, at: Any, size: Any, paint: int, turn: Any = (0, 0, 0), motion: Thing | None = None) -> None:
        """Put a thing into the scene; a moving thing gets its own number."""
        self.moving += motion is not None
        number = self.moving if motion is not None else 0
        made = {"shape": shape, "at": list(at), "size": list(size), "turn": list(turn), "material": paint}
        self.objects.append(made | {"motion": motion, "index": number, "seed": self.rng.randrange(2**31)})

    def spot(self, radius: float, reach: float) -> tuple[float, float] | None:
        """A free place within `reach` of the middle that the camera does not run into; None if there is none."""
        for _ in range(20):
            angle, far = self.rng.uniform(0, 2 * math.pi), reach * math.sqrt(self.rng.random())
            x, y = self.centre[0] + far * math.cos(angle), self.centre[1] + far * math.sin(angle)
            if self.free((x, y, 1.0), radius):
                return x, y
        return None

    def free(self, at: Any, radius: float) -> bool:
        """Whether a thing of this radius stays clear of the camera's way."""
        return all(distance((eye[0], eye[1], 0), (at[0], at[1], 0)) > radius + 0.25 * self.away for eye in self.walk)


def _ground(scene: Scene) -> None:
    """The ground, on which everything stands."""
    rng = scene.rng
    kind = {"field": "noise", "table": None, "hall": rng.choice(("checker", "brick"))}.get(scene.layout)
    if scene.clean:
        kind = rng.choice(("checker", "checker", "plain"))
    floor = scene.paint(kind or rng.choice(("checker", "brick", "noise", "voronoi", "wave", "text")), metal=0.05)
    if scene.level:
        scene.materials[floor]["scale"] *= rng.uniform(0.1, 1)
    if scene.layout == "table":
        scene.put("cube", (0, 0, -0.1), (6, 6, 0.2), floor)
        scene.put("plane", (0, 0, -1.5), (60, 60, 1), scene.paint("noise", 0))
    else:
        scene.put("plane", (0, 0, 0), (90, 90, 1), floor)


def _walls(scene: Scene) -> None:
    """The walls of a hall, the houses of a street, or a few far things."""
    rng, far = scene.rng, scene.away + 4
    if scene.level:
        level.wall(scene)
    elif scene.layout == "hall":
        for i in range(4):
            c, s = (1, 0, -1, 0)[i], (0, 1, 0, -1)[i]
            scene.put("cube", (c * far, s * far, 3), (0.4 if c else 2 * far, 0.4 if s else 2 * far, 6), scene.paint(metal=0.1))
    elif scene.layout == "street":
        for _ in range(rng.randint(6, 12)):
            angle, tall = rng.uniform(0, 2 * math.pi), rng.uniform(2, 14)
            away, wide = rng.uniform(1.1, 2.2) * scene.away, rng.uniform(2, 6)
            at = (away * math.cos(angle), away * math.sin(angle), tall / 2)
            if scene.free(at, wide):
                scene.put("cube", at, (wide, wide, tall), scene.paint(rng.choice(("windows", "brick", "text"))))
    elif scene.layout == "yard":
        for i in range(2):
            turn = (0, 0, i * math.pi / 2)
            at = (0, 1.3 * scene.away, 1) if i == 0 else (1.3 * scene.away, 0, 1)
            scene.put("fence", at, (2.5 * scene.away, 2, 2), scene.paint("plain", 0.5), turn)


def _furnish(scene: Scene) -> None:
    """Things that rest: solids, thin things, signs, foliage."""
    rng, unit = scene.rng, scene.away / 9
    solids, thin, signs, plants = rng.randint(4, 10), rng.randint(1, 4), rng.randint(0, 3), rng.randint(0, 3)
    if scene.layout == "field":
        plants += 7
    if scene.clean:
        plants //= 3
        slender.poles(scene)
    shapes = SOLIDS
    if scene.woven:
        solids, shapes = solids + 8, (*SOLIDS, "monkey", "monkey", "torus", "letters")
    if scene.level:
        thin, signs, plants, shapes = thin // 3, signs // 3, plants // 5, level.SOLIDS
        level.words(scene)
    leaves = [scene.paint("leaves") for _ in range(2)]
    slender.grass(scene)
    slender.wires(scene)
    for shape in [rng.choice(shapes) for _ in range(solids)]:
        size = [unit * rng.uniform(0.5, 1.6 if scene.level else 2.2) for _ in range(3)]
        size = size if shape in ("cube", "cylinder") else [size[0]] * 3
        if spot := scene.spot(max(size) / 2, 5 * unit):
            scene.put(shape, (*spot, size[2] / 2), size, scene.paint(), (0, 0, rng.uniform(0, 6)))
    for shape in [rng.choice(THIN) for _ in range(thin)]:
        size = [unit * rng.uniform(1.5, 5)] * 3
        if spot := scene.spot(size[0] / 2, 6 * unit):
            scene.put(shape, (*spot, size[2] / 2), size, scene.paint("plain", 0.5), (0, 0, rng.uniform(0, 6)))
    for _ in range(signs):
        if spot := scene.spot(unit, 6 * unit):
            written = scene.paint(rng.choice(("text", "text", "stripes", "mesh")), 0)
            facing = math.atan2(scene.walk[0][1] - spot[1], scene.walk[0][0] - spot[0]) + math.pi / 2 + rng.uniform(-0.5, 0.5)
            scene.put("card", (*spot, 1.4 * unit), [unit * rng.uniform(1.5, 3)] * 3, written, (0, 0, facing))
            scene.put("cylinder", (*spot, 0.7 * unit), (0.05 * unit, 0.05 * unit, 1.4 * unit), scene.paint("plain"))
    for _ in range(plants):
        tall = unit * rng.uniform(0.8, 3.5)
        if spot := scene.spot(tall / 2, 7 * unit):
            scene.put("bush", (*spot, tall / 2), [tall] * 3, rng.choice(leaves))


def _motion(scene: Scene) -> Thing:
    """How something moves; half of all slide through the picture, one in six of them fast."""
    rng = scene.rng
    speed = rng.uniform(7, 16) if rng.random() < (0.05 if scene.level else 0.17) else scene.speed()
    metres, angle = speed * scene.away / scene.focal, rng.uniform(0, 2 * math.pi)
    kind = rng.choice(("slide", "slide", "slide", "circle", "bob", "swing", "spin"))
    spin = [rng.uniform(-0.15, 0.15) for _ in range(3)] if kind == "spin" or rng.random() < 0.4 else [0.0, 0.0, 0.0]
    motion: Thing = {"kind": kind, "rate": metres, "phase": angle, "spin": spin}
    if kind == "slide":
        motion |= {"along": [math.cos(angle), math.sin(angle), 0.0], "middle": rng.uniform(0.2, 0.8) * scene.frames}
    if kind in ("circle", "bob", "swing"):
        radius = (
            {"circle": 0.15, "bob": 0.06, "swing": 0.6}[kind] * rng.uniform(0.5, 1.5) * (1 if kind == "swing" else scene.away)
        )
        motion |= {"radius": radius, "rate": min(0.5, metres / radius)}
    return motion


def _actors(scene: Scene) -> None:
    """Things that move: solids, thin things, writing and foliage."""
    rng, unit = scene.rng, scene.away / 9
    for _ in range(rng.randint(2, 6)):
        shape = rng.choice((*SOLIDS, *SOLIDS, "wheel", "lattice", "fence", "card", "card", "letters", "letters"))
        texture = rng.choice(CUTOUTS + PICTURES) if shape == "card" else "plain" if shape in THIN else None
        size = unit * rng.uniform(0.6, 2.0)
        if spot := scene.spot(size, 3.5 * unit):
            at = (*spot, size / 2 + unit * rng.choice((0, 0.2, 1, 2)))
            scene.put(shape, at, [size] * 3, scene.paint(texture), (0, 0, rng.uniform(0, 6)), _motion(scene))


def _another_path(scene: Scene, path: int) -> None:
    """Other shots of the same scene; of twenty draws the first whose camera runs into nothing."""
    scene.rng = random.Random(f"stss blender {VERSION} {scene.split} {scene.seed} path {path}")
    for _ in range(20):
        scene.shots = scene._shots()
        scene.walk = [camera(scene.shots, t)[0] for t in range(-1, scene.frames + 1)]
        solid = (thing for thing in scene.objects if max(thing["size"]) < scene.away)
        if all(scene.free(thing["at"], 0.5 * max(thing["size"]) - 0.1 * scene.away) for thing in solid):
            return


def describe(seed: int, split: str, frames: int, path: int = 0) -> Thing:
    """The scene of a seed.

    Args:
        seed: any number.
        split: "train", "validation" or "test": the same seed gives another scene in each.
        frames: how many there will be.
        path: another number is another way of the camera through the same scene.

    Returns:
        The description that `assemble.py` builds and `scene.json` stores: plain numbers, lists and words.
    """
    if frames < 1:
        raise ValueError(f"frames: expected 1 or more, got {frames}")
    scene = Scene(seed, split, frames)
    for step in (_ground, _walls, _furnish, _actors):
        step(scene)
    behind, lamps = sky(scene.rng, scene.mood), lights(scene.rng, scene.mood, scene.centre, frames)
    if scene.clean:
        lamps = [lamps[0] | {"soft": 0.0}]
        behind["lights"] = False
    if path:
        _another_path(scene, path)
    used = {scene.materials[thing["material"]]["texture"] for thing in scene.objects}
    contents = sorted({thing["shape"] for thing in scene.objects} | used)
    moves = [shot["move"] for shot in scene.shots] + ["shake"] * any(shot["shake"] for shot in scene.shots)
    told = (
        "seed",
        "split",
        "frames",
        "layout",
        "mood",
        "clean",
        "woven",
        "level",
        "moving",
        "fov",
        "shots",
        "materials",
        "objects",
    )
    return {name: getattr(scene, name) for name in told} | {
        "version": VERSION,
        "path": path,
        "camera": moves,
        "cuts": [shot["first"] + 1 for shot in scene.shots[1:]],
        "contents": contents,
        "sky": behind,
        "lights": lamps,
    }


def plan(scenes: int, kind: str = "any", frames: int = 1) -> list[tuple[str, int]]:
    """Split and seed of each scene of a set, mixed, so that one that was stopped early has some of each."""

    def suitable(split: str) -> Iterator[int]:
        return (seed for seed in count() if kind == "any" or describe(seed, split, frames)[kind])

    seeds = {split: suitable(split) for split in SPLITS}
    splits = ({3: "validation", 7: "test"}.get(i % ROUND, "train") for i in range(scenes))
    return [(split, next(seeds[split])) for split in splits]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Print split and seed of each scene of a set, for render.py.")
    parser.add_argument("--scenes", type=int, default=64, help="in all; more later adds to the set")
    parser.add_argument("--kind", choices=KINDS, default="any", help="of scenes; the others' seeds are left out")
    parser.add_argument("--frames", type=int, default=12, help="of each scene")
    given = parser.parse_args()
    sys.stdout.writelines(f"{split} {seed}\n" for split, seed in plan(given.scenes, given.kind, given.frames))
