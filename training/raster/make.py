# SPDX-License-Identifier: MIT
"""Make clips of a rasteriser: draw them from their numbers, render them in headless Chromium, write them as profile `stss`."""

from __future__ import annotations

import argparse
import json
import math
import shutil
import subprocess
import zlib
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from stss.images.read_write import write_channels, write_rgb
from stss_ground.errors import InputError
from training.command import command

Clip = dict[str, Any]
Plane = NDArray[np.float32]

TRACKS = (
    "abyss", "cocoa_temple", "cornfield_crossing", "gran_paradiso_island", "hacienda", "lighthouse", "mines", "olivermath",
    "ravenbridge_mansion", "sandtrack", "snowmountain", "stk_enterprise", "volcano_island", "xr591",
)  # fmt: skip
VALIDATION = ("scotland", "zengarden")
HELD_OUT = ("candela_city", "black_forest")
"""No clip shows these, since views of them are measured."""
SURFACES = (
    "castelwall.jpg", "beige_bricks.jpg", "city_bricks.png", "cottage_wall1.jpg", "dark-wall-wood.png", "dirtbrick.png", "marble.jpg",
    "oldWood.png", "Paving_stones_2.jpg", "pyramidwall.jpg", "rockwall.jpg", "stk_corrugMetal_a.png", "stk_generic_brickRoad_a.png",
    "stk_generic_carpet_a.png", "stk_generic_oldbricks_a.png", "stk_generic_wallRock_a.png", "stk_wallpaperOld_a.png",
    "stktex_generic_WoodA.png", "stktex_generic_WoodC.png", "stktex_generic_WoodD.png", "stktex_generic_WoodE.png",
    "stktex_generic_aztekWall_a.png", "stktex_generic_cobbleStoneA.png", "stktex_generic_concreteA.png", "stktex_generic_marbleA.png",
    "stktex_generic_stoneWallA.png", "stktex_generic_tilesA.png", "stktex_generic_tilesB.png", "tiles.png", "wood_planks1.jpg",
)  # fmt: skip
THINGS = (
    "stklib_armchair_a", "stklib_classchair_a", "hd_metalWoodOldChest_a", "stklib_fitchBarrel_a", "stklib_gramophone_a",
    "stklib_aztekVase_a", "stklib_easel_a", "stklib_jackOLantern_a", "stklib_computer_a", "stklib_hayBall_a", "stklib_bench_a",
    "stklib_agave_a", "stklib_candle_a", "stklib_fern_a", "hd_chineseRedLantern_a", "stklib_cabbage_a",
)  # fmt: skip
PLANTS = (
    "stklib_accacia_a", "stklib_cocoaTree_a", "stklib_cypress_a", "stklib_tropicalPlant_a", "stklib_lowPineTree_a", "stklib_agave_a",
    "stklib_autumnSmallBush_a", "stklib_autumnTree_a", "stklib_snowSmallBush_a", "stklib_lowPalmTree_a", "hd_palmTree_a", "stklib_liana_a",
)  # fmt: skip
"""None of black_forest's."""
GROUNDS = (
    "grass2.jpg",
    "grass_dark.jpg",
    "stk_generic_dirtGrassA.png",
    "dirt.jpg",
    "sand2.jpg",
    "stk_generic_grassB.png",
    "road_dirt.jpg",
)
KARTS = ("tux", "konqi", "gnu", "kiki", "suzanne", "wilber", "puffy", "nolok", "pidgin", "xue")
DAY, DUSK, NIGHT = ("park", "sky", "esplanade", "bridge", "venice"), ("dawn", "sunset", "sunrise"), ("night",)
FRAMES, TRUTHS, SIZE = 7, (5, 6), (256, 144)
"""An output needs five frames before its own; two outputs in a row show flicker."""
LONG, LONG_TRUTHS = 16, (12, 13, 14, 15)
"""A temporal upsampler needs more frames before its own."""
SAMPLES = 4
"""The truth has SAMPLES x SAMPLES samples a pixel."""
LIGHT = ("sky", "skyGain", "sun", "sunColor", "sunPower", "exposed")
JITTER = ((0, 0), (0.5, 0.5), (0.5, 0), (0, 0.5))
"""The camera's shifts in pixels, x right, y down, each for two frames in turn."""
HALTON = 16
"""Offsets of temporal upsamplers, one for each frame in turn."""
FAR = 1e7
"""Position of the sky, cm."""
FAR_DEPTH = 1e10
"""Its depth: profile `stss` takes 1e9 and more for the background."""


def draw_clip(number: int, track: str | None = None) -> Clip:
    """The clip with this number: four of each track in turn, the rest is chance; of one track, under its one light, with a LOD bias."""
    if track is not None:
        light = draw_clip(zlib.crc32(track.encode()))
        own = {"name": f"{track}_{number:03}", "track": track, "bias": -1.0}
        return draw_clip(number) | {name: light[name] for name in LIGHT} | own
    random = np.random.default_rng(number)
    track = (*TRACKS, *VALIDATION)[number // 4 % (len(TRACKS) + len(VALIDATION))]
    camera = ("fly", "pan", "fly", "still")[number % 4]
    height = float(random.choice((0.7, 1.7, 3.5, 7.0)))
    skies, power, color, lift = (
        (DAY, 3.0, "#fff0dd", (0.4, 1.2)),
        (DUSK, 2.0, "#ffc080", (0.1, 0.4)),
        (DAY, 0.5, "#e8f0ff", (0.5, 1.2)),
        (NIGHT, 0.4, "#90a8ff", (0.4, 1.2)),
    )[random.choice(4, p=(0.5, 0.2, 0.15, 0.15))]
    angle = random.uniform(0, 2 * math.pi)
    karts = [
        {
            "name": str(random.choice(KARTS)),
            "ahead": float(random.uniform(3 + 4 * i, 8 + 5 * i)),
            "speed": float(random.choice((0, 12, 18, 25, -10))),
            "aside": float(random.uniform(-2.5, 2.5)),
            "spin": float(random.choice((0, 0, -2, 3))),
        }
        for i in range(int(random.integers(1, 4)))
    ]
    return {
        "name": f"{track}_{number:03}",
        "track": track,
        "start": float(random.random()),
        "camera": camera,
        "speed": float(random.uniform(5, 25)),
        "turn": float(random.choice((-1, 1)) * random.uniform(0.1, 0.6)),
        "aside": float(random.uniform(-2, 2)),
        "height": height,
        "yaw": float(random.uniform(-0.4, 0.4) if camera == "fly" else random.uniform(-1.2, 1.2)),
        "pitch": float(random.uniform(-0.15, 0.12) - 0.03 * height),
        "fov": float(random.choice((40, 55, 65, 75))),
        "karts": karts,
        "sky": str(random.choice(skies)),
        "skyGain": float(random.choice((1.0, 0.5, 0.15))),
        "sun": [math.cos(angle), float(random.uniform(*lift)), math.sin(angle)],
        "sunColor": color,
        "sunPower": power,
        "bias": float(random.choice((-1, -1, 0))),
        "anisotropy": 1,
        "exposed": float(random.uniform(0.08, 0.25)),
        "size": SIZE,
        "frames": FRAMES,
        "truths": TRUTHS,
        "samples": SAMPLES,
    }


def draw_room(number: int) -> Clip:
    """The room with this number: textured walls from near, things and spinning karts, a camera that mostly stands still."""
    random = np.random.default_rng((1, number))
    near, depth = random.uniform(2.5, 6), random.uniform(5, 12)
    near = min(near, depth - 1)

    def put(things: int) -> list[dict[str, float]]:
        return [{"ahead": random.uniform(near, depth - 0.5), "aside": random.uniform(-3, 3)} for _ in range(things)]

    things = [{**at, "name": str(random.choice(THINGS)), "turn": random.uniform(-3, 3)} for at in put(5)]
    karts = [
        {**at, "name": str(random.choice(KARTS)), "speed": random.choice((0, 0, -1.5, 2.0)), "spin": random.uniform(-4, 4),
         "lift": random.choice((0, random.uniform(0.2, 1.5))), "tumble": random.choice((0, random.uniform(-3, 3)))}
        for at in put(int(random.integers(1, 4)))
    ]  # fmt: skip
    return draw_clip(number) | {
        "name": f"room_{number:03}",
        "track": None,
        "room": {
            "surfaces": [(str(random.choice(SURFACES)), random.uniform(0.8, 4)) for _ in range(4)],
            "width": random.uniform(8, 14),
            "depth": depth,
            "height": random.uniform(3, 8),
            "things": things,
        },
        "camera": "pan" if number % 4 == 3 else "still",
        "aside": random.uniform(-1.5, 1.5),
        "height": random.uniform(0.8, 3.5),
        "yaw": random.uniform(-0.5, 0.5),
        "pitch": random.uniform(-0.3, 0.05),
        "fov": random.uniform(30, 65),
        "karts": karts,
        "anisotropy": int(random.choice((1, 4, 16))),
    }


def draw_grove(number: int) -> Clip:
    """The grove with this number: plants along a straight way between four walls, a camera that mostly flies."""
    random = np.random.default_rng((2, number))
    clip, width, depth = draw_room(number), random.uniform(16, 40), random.uniform(20, 60)
    plants = [
        {"name": str(random.choice(PLANTS)), "turn": random.uniform(-3, 3), "ahead": random.uniform(2, depth),
         "aside": random.choice((-1, 1)) * random.uniform(2, width / 2)}
        for _ in range(int(random.integers(15, 40)))
    ]  # fmt: skip
    surfaces = [(str(random.choice(GROUNDS)), random.uniform(2, 6)), *clip["room"]["surfaces"][1:]]
    room = clip["room"] | {
        "surfaces": surfaces,
        "width": width,
        "depth": depth,
        "height": random.uniform(0.5, 4),
        "things": plants,
    }
    camera = ("fly", "fly", "pan", "still")[number % 4]
    karts, fov = draw_clip(number)["karts"], random.uniform(40, 75)
    return clip | {"name": f"grove_{number:03}", "room": room, "camera": camera, "karts": karts, "fov": fov}


def draw_chase(number: int) -> Clip:
    """The chase with this number: a camera that follows a fast kart, others that overtake, posts and gantries near the road.

    Half of them on a track, half on an open floor, of which half is nearly plain.
    """
    random = np.random.default_rng((3, number))
    clip, speed = (draw_clip(4 * (number // 8)) if number % 2 else draw_grove(number)), random.uniform(15, 60)
    followed = {
        "ahead": random.uniform(3.2, 7),
        "aside": random.uniform(-1, 1),
        "speed": speed,
        "spin": random.choice((0, 0, -0.8, 0.8)),
    }
    others = [
        {"ahead": random.uniform(0, 10), "aside": random.choice((-1, 1)) * random.uniform(1.6, 4), "spin": 0,
         "speed": random.choice((speed + random.uniform(-20, 20), random.uniform(-30, 0)))}
        for _ in range(int(random.integers(1, 3)))
    ]  # fmt: skip
    if clip["track"] is None:
        room = clip["room"]
        floor, length = (
            (str(random.choice((*GROUNDS, *SURFACES))), random.uniform(*((3, 10) if random.random() < 0.5 else (40, 90)))),
            120,
        )
        clip |= {"room": room | {"surfaces": [floor, *room["surfaces"][1:]], "depth": length, "things": room["things"][:12]}}
    return clip | {
        "name": f"{clip['track'] or 'road'}_chase{number:03}",
        "camera": "fly",
        "speed": speed,
        "aside": random.uniform(-0.8, 0.8),
        "height": random.uniform(0.8, 2.5),
        "yaw": random.uniform(-0.15, 0.15),
        "pitch": random.uniform(-0.2, 0.0),
        "fov": random.uniform(45, 75),
        "karts": [{**kart, "name": str(random.choice(KARTS))} for kart in (followed, *others)],
        "boxes": _draw_posts(random) + (_draw_gantry(random) if random.random() < 0.6 else []),
    }


def _draw_posts(random: np.random.Generator) -> list[dict[str, Any]]:
    """Posts on both sides of the road: where, their middle, their width, height and length in metres."""
    step, width, height = random.uniform(3, 15), random.uniform(0.06, 0.5), random.uniform(1, 6)
    aside, surface = random.uniform(2.2, 6), str(random.choice(SURFACES))
    return [
        {
            "ahead": step * i + random.uniform(0, 2),
            "aside": side * aside,
            "up": height / 2,
            "size": (width, height, width),
            "surface": surface,
        }
        for i in range(12)
        for side in (-1, 1)
    ]


def _draw_gantry(random: np.random.Generator) -> list[dict[str, Any]]:
    """A gantry over the road: two beams, thin bars between them, two feet."""
    ahead, half, top, thin = random.uniform(5, 30), random.uniform(4, 8), random.uniform(3, 6), random.uniform(0.05, 0.25)
    bars = np.arange(-half, half, random.uniform(0.4, 1.2))
    parts = [(0, top + lift, (2 * half, thin, thin)) for lift in (0, 0.8)]
    parts += [(x, top + 0.4, (thin / 2, 0.8, thin / 2)) for x in bars] + [
        (x, top / 2, (2 * thin, top, 2 * thin)) for x in (-half, half)
    ]
    surface = str(random.choice(SURFACES))
    return [{"ahead": ahead, "aside": float(x), "up": up, "size": size, "surface": surface} for x, up, size in parts]


def jitter(clip: Clip, kind: str | None) -> Clip:
    """The clip with the camera's shift in each frame, by ``kind``: ``half`` pixels, the truth's too, or ``halton``, the truth's not."""
    if kind == "halton":
        points = qmc.Halton(2, scramble=False).random(HALTON + 1)[1:] - 0.5
        shifts = [tuple(points[n % HALTON].tolist()) for n in range(clip["frames"])]
    else:
        shifts = [JITTER[n // 2 % len(JITTER)] for n in range(clip["frames"])]
    return clip | {"jitter": shifts if kind else None, "steady": kind == "halton"}


def write_clip(raw: Path, clip: Mapping[str, Any], out: Path) -> None:
    """Write ``out/lr``, ``out/hr`` and ``out/camera.csv`` of a rendered clip: centimetres, z up, colours exposed alike.

    Where the truth has no jitter, ``out/jitter.csv`` has the shift of each image, against that of the camera.
    """
    name, (width, height) = clip["name"], clip["size"]
    partial = out.with_name(f".{out.name}")
    shutil.rmtree(partial, ignore_errors=True)
    for folder in ("lr", "hr"):
        (partial / folder).mkdir(parents=True)

    def read(what: str, scale: int = 1) -> Plane:
        return np.fromfile(raw / f"{name}.{what}", np.float32).reshape(scale * height, scale * width, 4)[::-1]

    exposure = clip["exposed"] / max(float(np.median(read("0.0")[..., :3].mean(-1))), 1e-4)
    lines = ["frame,x,y,z"]
    for frame, eye in enumerate(json.loads((raw / f"{name}.eyes.json").read_text())):
        planes = [read(f"{frame}.{i}") for i in range(5)]
        write_channels(partial / "lr" / f"frame.{frame:04}.exr", _channels(planes, exposure))
        if frame in clip["truths"]:
            write_rgb(partial / "hr" / f"frame.{frame:04}.exr", exposure * read(f"{frame}.truth", 2)[..., :3])
        lines.append(f"{frame}," + ",".join(f"{v:.4f}" for v in 100 * _upright(np.array(eye))))
    (partial / "camera.csv").write_text("\n".join(lines) + "\n")
    if clip.get("steady"):
        shifts = [f"{frame},{-x:.6f},{-y:.6f}" for frame, (x, y) in enumerate(clip["jitter"])]
        (partial / "jitter.csv").write_text("\n".join(("frame,x,y", *shifts)) + "\n")
    partial.rename(out)


def _channels(planes: Sequence[Plane], exposure: float) -> dict[str, Plane]:
    color, base, normal, position, motion = planes
    sky = position[..., 3] <= 0
    length = np.linalg.norm(normal[..., :3], axis=-1, keepdims=True)
    normals = np.where(sky[..., None], 0, _upright(normal[..., :3]) / np.maximum(length, 1e-6))
    places = np.where(sky[..., None], FAR, 100 * _upright(position[..., :3]))
    channels = {c: exposure * np.maximum(color[..., i], 0) for i, c in enumerate("RGB")}
    channels |= {f"basecolor.{c}": base[..., i] for i, c in enumerate("RGB")}
    channels |= {f"normal.{c}": normals[..., i] for i, c in enumerate("XYZ")}
    channels |= {f"position.{c}": places[..., i] for i, c in enumerate("XYZ")}
    channels |= {"motion.X": motion[..., 0], "motion.Y": motion[..., 1], "depth.Z": np.where(sky, FAR_DEPTH, position[..., 3])}
    return channels | {
        "roughness.X": base[..., 3],
        "metallic.X": np.where(sky, 0, normal[..., 3]),
        "stencil.X": np.where(sky, 0, motion[..., 2]),
        "nov.X": np.where(sky, 0, motion[..., 3]),
    }


def _upright(vectors: NDArray[Any]) -> NDArray[Any]:
    """three.js has y up; the other training frames have z up."""
    return np.stack([vectors[..., 0], -vectors[..., 2], vectors[..., 1]], -1)


DRAW = {"track": draw_clip, "room": draw_room, "grove": draw_grove, "chase": draw_chase}


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.raster.make``."""
    parser = argparse.ArgumentParser(prog="python -m training.raster.make", description=__doc__)
    parser.add_argument("--assets", type=Path, required=True, help="folder with node_modules/ and SuperTuxKart's data in stk/")
    parser.add_argument("--clips", type=int, default=64)
    parser.add_argument("--first", type=int, default=0, help="number of the first clip")
    parser.add_argument("--kind", choices=DRAW, default="track")
    parser.add_argument("--track", help="all clips of --kind track on this one, under one light")
    parser.add_argument(
        "--jitter",
        nargs="?",
        const="half",
        choices=("half", "halton"),
        help=f"shift the camera by half pixels, the truth's too, or by Halton's {HALTON} offsets, the truth's not (jitter.csv)",
    )
    parser.add_argument("--long", action="store_true", help=f"{LONG} frames, the last {len(LONG_TRUTHS)} with truth")
    parser.add_argument("--size", nargs=2, type=int, default=SIZE, metavar=("W", "H"), help="of the small frames")
    parser.add_argument("-o", "--out", type=Path, required=True, help="a folder for each clip; an existing one is not made again")
    options = parser.parse_args(arguments)
    if options.track in HELD_OUT:
        raise InputError(f"--track {options.track}: expected another track: views of {' and '.join(HELD_OUT)} are measured")
    if not all(side % 8 == 0 and 8 <= side <= 2048 for side in options.size):
        raise InputError(f"--size {' '.join(map(str, options.size))}: expected multiples of 8 from 8 to 2048")
    draw = partial(draw_clip, track=options.track) if options.kind == "track" else DRAW[options.kind]
    form = {"size": options.size} | ({"frames": LONG, "truths": LONG_TRUTHS} if options.long else {})
    clips = [jitter(draw(n) | form, options.jitter) for n in range(options.first, options.first + options.clips)]
    raw = options.out / f".raw{options.first}"
    todo = [c for c in clips if not (options.out / c["name"]).exists()]
    raw.mkdir(parents=True, exist_ok=True)
    (raw / "clips.json").write_text(json.dumps(todo))
    subprocess.run(["node", Path(__file__).with_name("drive.mjs"), options.assets, raw / "clips.json", raw], check=True)
    for clip in todo:
        write_clip(raw, clip, options.out / clip["name"])
    shutil.rmtree(raw)


if __name__ == "__main__":
    command(main)
