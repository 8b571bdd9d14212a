# SPDX-License-Identifier: MIT
"""Render clips of random things before a sky with Mitsuba 3, samples spread over the pixel: ``pip install mitsuba``.

Cameras are fast and some things thin. Lights are directional and the path ends at the first surface, so that a pixel's samples differ
by what they see and by nothing else: the truth has no noise. The sky is one colour, put behind by the share of the samples that hit
nothing. Half of the clips have a G-buffer of means over the pixel, as Mitsuba and Cycles write it, the others that of the pixel's centre.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from stss.images.read_write import write_channels
from stss.sequence.camera import FAR, PLACE
from stss_ground.terminal import echo
from stss_ref.arrays import Array
from training.command import command
from training.patterns import Random

SIZE = 104, 176
"""(H, W) of the small frames."""
FRAMES, TRUTH = 7, (6, 7)
"""Number of frames of a clip, from 1, and those that have a truth."""
SAMPLES = 25
"""Samples of a pixel, in both sizes."""
AOVS = "depth:depth, position:position, normal:sh_normal, albedo:albedo"
UP = [0, 1, 0]
Pose = tuple[Array, Array]
"""A camera's place and the place that it looks at, (3,) each."""


def random_texture(random: Random) -> dict[str, Any]:
    """A reflectance: plain, checkers, stripes, or noise."""
    a, b = random.uniform(0.03, 0.9, (2, 3))
    kind, side, steps = int(random.integers(4)), 128, int(random.integers(2, 24))
    if kind == 0:
        return {"type": "rgb", "value": a.tolist()}
    y, x = np.mgrid[:side, :side] * steps // side
    share = [(x + y) % 2, x % 2, random.random((steps, steps))[y, x]][kind - 1][..., None]
    return {"type": "bitmap", "data": mi.TensorXf((share * a + (1 - share) * b).astype(np.float32)), "raw": True}


def random_scene(random: Random) -> dict[str, Any]:
    """Things, poles and rails, mostly above a ground."""
    parts: dict[str, Any] = {}

    def add(shape: dict[str, Any]) -> None:
        parts[f"thing {len(parts)}"] = {**shape, "bsdf": {"type": "diffuse", "reflectance": random_texture(random)}}

    move = mi.ScalarTransform4f()
    if random.random() < 0.85:
        add({"type": "rectangle", "to_world": move.rotate([1, 0, 0], -90).scale([30, 30, 1])})
    for _ in range(int(random.integers(16, 50))):
        x, z, size = random.uniform(-7, 7), random.uniform(-12, 3), np.exp(random.uniform(-1.3, 0.6))
        kind = int(random.integers(4))
        if kind == 0:
            half = size * random.uniform(0.2, 1, 3)
            add(
                {
                    "type": "cube",
                    "to_world": move.translate([x, half[1], z]).rotate(UP, random.uniform(0, 90)).scale(half.tolist()),
                }
            )
        elif kind == 1:
            add({"type": "sphere", "center": [x, size + random.uniform(0, 1), z], "radius": size})
        elif kind == 2:
            add({"type": "cylinder", "p0": [x, 0, z], "p1": [x, 1 + 2 * size, z], "radius": 0.01 + 0.05 * size})
        else:
            dx, dz, y = *random.normal(0, 3, 2), random.uniform(0.3, 2.5)
            add({"type": "cylinder", "p0": [x, y, z], "p1": [x + dx, y, z + dz], "radius": 0.01 + 0.03 * size})
    for down, least, most in ((-0.8, 1.5, 4.0), *((random.uniform(-1, 0.5), 0.3, 1.0) for _ in range(4))):
        light = random.uniform(least, most) * random.uniform(0.75, 1, 3)
        irradiance = {"type": "rgb", "value": light.tolist()}
        parts[f"light {len(parts)}"] = {
            "type": "directional", "direction": [random.normal(), down, random.normal()], "irradiance": irradiance
        }  # fmt: skip
    return {"type": "scene", "integrator": {"type": "aov", "aovs": AOVS, "img": {"type": "direct"}}, **parts}


def random_poses(random: Random) -> list[Pose]:
    """The camera in each frame: it moves and turns steadily."""
    place = np.array([random.normal(0, 1.5), random.uniform(0.5, 2.5), random.uniform(4, 6)])
    target = random.normal([0, 1.2, 0], 0.7)
    step = random.normal(0, 1, 3) * [1, 0.3, 1] * np.exp(random.uniform(-4, -1))
    turn = random.normal(0, 1, 3) * [1, 0.4, 0] * np.exp(random.uniform(-3.5, -0.7)) * (random.random() < 0.7)
    return [(place + t * step, target + t * (step + turn)) for t in np.arange(FRAMES) - FRAMES / 2]


def camera_line(frame: int, pose: Pose, fov: float) -> str:
    """A line of a camera table, see `stss.sequence.camera.CameraPose`; ``fov`` in degrees, across."""
    place, target = pose
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right)
    lens = 1 / np.tan(np.radians(fov) / 2)
    rows = [lens * right, lens * SIZE[1] / SIZE[0] * np.cross(forward, right), forward]
    return ",".join(map(str, (frame, *place, *np.concatenate(rows))))


def look(world: Any, pose: Pose, fov: float, size: tuple[int, int], samples: int, seed: int = 0) -> dict[str, Array]:
    """The planes (H, W, C) of a frame, by Mitsuba's names; of the pixel's centre where ``samples`` is 1."""
    sensor = mi.load_dict({
        "type": "perspective", "fov": fov, "to_world": mi.ScalarTransform4f().look_at(*(p.tolist() for p in pose), UP),
        "film": {"type": "hdrfilm", "height": size[0], "width": size[1], "component_format": "float32", "rfilter": {"type": "box"}},
        "sampler": {"type": "stratified", "sample_count": samples, "jitter": samples > 1, "seed": seed},
    })  # fmt: skip
    mi.render(world, sensor=sensor, spp=samples)
    planes = {name: np.array(bitmap, np.float32) for name, bitmap in sensor.film().bitmap().split()}
    return {name: plane.reshape(*size, -1) for name, plane in planes.items()}


def render_clip(number: int, folder: Path) -> None:
    """Render clip ``number``: ``lr/`` and ``hr/`` for profile ``mitsuba``, and ``camera.csv``."""
    random = np.random.default_rng([number, 20261128])
    world, sky, fov = mi.load_dict(random_scene(random)), random.uniform(0.05, 1, 3), float(random.uniform(40, 80))
    is_mean, lines = bool(random.random() < 0.5), [",".join([*PLACE, *FAR])]
    (folder / "lr").mkdir(parents=True), (folder / "hr").mkdir()

    def color(planes: dict[str, Array]) -> dict[str, Array]:
        image = planes["img"][..., :3] + (1 - planes["img"][..., 3:]) * sky
        return {c: image[..., i] for i, c in enumerate("RGB")}

    for frame, pose in enumerate(random_poses(random), start=1):
        small = look(world, pose, fov, SIZE, SAMPLES, frame)
        aovs = small if is_mean else look(world, pose, fov, SIZE, 1)
        letters = {"depth": "T", "position": "XYZ", "normal": "XYZ", "albedo": "RGB"}
        planes = {f"{name}.{c}": aovs[name][..., i] for name, of in letters.items() for i, c in enumerate(of)}
        write_channels(folder / "lr" / f"sky.{frame:04d}.exr", color(small) | planes)
        if frame in TRUTH:
            large = look(world, pose, fov, (2 * SIZE[0], 2 * SIZE[1]), SAMPLES, frame)
            write_channels(folder / "hr" / f"sky.{frame:04d}.exr", color(large))
        lines.append(camera_line(frame, pose, fov))
    (folder / "camera.csv").write_text("\n".join(lines) + "\n")


def main() -> None:
    """Render clips; a folder that is there is kept."""
    parser = argparse.ArgumentParser(prog="python -m training.skies", description=__doc__)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--clips", type=int, required=True)
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    mi.set_variant("scalar_rgb")
    for number in range(options.first, options.first + options.clips):
        folder = options.out / f"sky-{number}"
        if not folder.exists():
            render_clip(number, folder)
            echo(str(folder))


if __name__ == "__main__":
    command(main)
