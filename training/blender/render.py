# SPDX-License-Identifier: MIT
"""Render one random scene with Cycles: small frames with their G-buffer, aliased or not, and the truth at twice the size.

Runs where `bpy` is installed; needs nothing of stss::

    python render.py --scene 7 --split train --size 160x90 --frames 16 -o out
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy
from assemble import build
from paths import camera
from scenes import SPLITS, VERSION, describe

POINT = 0.01
"""Smallest filter width, pixels: every sample lies at the pixel's centre."""


EXACT = 2
"""Samples of a small frame's pixel in a clean scene, whose light has no noise, so that every sample gives the same answer."""


def common(scene: Any, threads: int) -> None:
    """Set what both renderings share: Cycles on the CPU, few bounces, no denoising, no motion blur."""
    scene.render.engine = "CYCLES"
    scene.render.resolution_percentage = 100
    scene.render.use_motion_blur = False  # with it there is no Vector pass
    scene.render.use_persistent_data = True
    scene.render.threads_mode, scene.render.threads = "FIXED", threads
    scene.render.use_file_extension = False
    cycles = scene.cycles
    cycles.device, cycles.use_denoising, cycles.use_adaptive_sampling = "CPU", False, False
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 1, 0, 1
    cycles.transparent_max_bounces = 16
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_indirect = 3.0
    cycles.use_light_tree = False


def small(scene: Any, size: tuple[int, int], samples: int, *, aliased: bool) -> None:
    """Set up colour and G-buffer. If aliased, every sample lies at the pixel's centre, and more samples only reduce the light's noise."""
    scene.render.resolution_x, scene.render.resolution_y = size
    # Not a small BOX filter, since Cycles makes that 1 pixel wide, whatever the width says.
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = ("GAUSSIAN", POINT) if aliased else ("BOX", 1.0)
    scene.cycles.samples = samples
    layer = scene.view_layers[0]
    for name in ("combined", "z", "vector", "normal", "position", "object_index", "diffuse_color"):
        setattr(layer, f"use_pass_{name}", True)
    _as_exr(scene, layers=True)


def truth(scene: Any, size: tuple[int, int], samples: int) -> None:
    """Set up colour at twice the size, with samples spread evenly over the pixel."""
    scene.render.resolution_x, scene.render.resolution_y = 2 * size[0], 2 * size[1]
    scene.cycles.pixel_filter_type, scene.cycles.samples = "BOX", samples
    layer = scene.view_layers[0]
    for name in ("z", "vector", "normal", "position", "object_index", "diffuse_color"):
        setattr(layer, f"use_pass_{name}", False)
    _as_exr(scene, layers=False)


def _as_exr(scene: Any, *, layers: bool) -> None:
    image = scene.render.image_settings
    if hasattr(image, "media_type"):  # Blender 5
        image.media_type = "MULTI_LAYER_IMAGE" if layers else "IMAGE"
    image.file_format = "OPEN_EXR_MULTILAYER" if layers else "OPEN_EXR"
    # Half for colours; the data passes stay float.
    image.color_depth, image.exr_codec = "16", "ZIP"
    if not layers:
        image.color_mode = "RGB"


def render_frames(folder: Path, frames: Iterable[int]) -> float:
    """Render the frames that do not exist yet, each file whole or not at all. Returns the seconds it took."""
    folder.mkdir(parents=True, exist_ok=True)
    scene, start = bpy.context.scene, time.monotonic()
    for number in frames:
        path = folder / f"frame.{number:04}.exr"
        if path.exists():
            continue
        half = folder / f".{path.name}.part"
        scene.frame_set(number)
        scene.cycles.seed = number
        scene.render.filepath = str(half)
        bpy.ops.render.render(write_still=True)
        half.replace(path)
    return time.monotonic() - start


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description="Render one random scene with Cycles.")
    parser.add_argument("--scene", type=int, required=True, help="seed of the scene")
    parser.add_argument("--path", type=int, default=0, help="another number: another way of the camera through the same scene")
    parser.add_argument("--split", choices=SPLITS, default="train")
    parser.add_argument("--size", default="160x90", help="of the small frames; the truth has twice the size")
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--samples", type=int, default=32, help="of a small frame's pixel")
    parser.add_argument("--truth-samples", type=int, default=36, help="of a truth's pixel, 16 or more")
    parser.add_argument("--truth-frames", type=int, nargs="+", metavar="N", help="which frames get a truth; default: all")
    parser.add_argument("--antialiased", action="store_true", help="samples spread over the pixel, G-buffer and all")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder; what is finished there is kept")
    given = parser.parse_args()
    try:
        width, height = (int(n) for n in given.size.split("x"))
    except ValueError:
        parser.error(f"--size: expected WIDTHxHEIGHT, got {given.size!r}")
    if min(width, height, given.frames, given.samples, given.threads) < 1 or given.truth_samples < 16:
        parser.error("expected positive numbers, and 16 or more --truth-samples")
    given.size = (width, height)
    return given


def claim(folder: Path, settings: dict[str, Any]) -> None:
    """Refuse to continue a folder that was begun with other settings or another scene."""
    folder.mkdir(parents=True, exist_ok=True)
    path, text = folder / "settings.json", json.dumps(settings)
    if path.exists() and path.read_text() != text:
        sys.exit(f"{folder}: begun with other settings, {path.read_text()}; choose another folder, or delete it")
    path.write_text(text)


def main() -> None:
    """Render a scene; `scene.json` is written last, so a folder that has it is finished."""
    given = arguments()
    described = describe(given.scene, given.split, given.frames, given.path)
    aliased, every = not given.antialiased, range(1, given.frames + 1)
    settings: dict[str, Any] = {"aliased": aliased, "size": given.size, "samples": given.samples}
    settings |= {"truth_samples": given.truth_samples, "truth_frames": given.truth_frames or list(every)}
    settings |= {"blender": bpy.app.version_string}
    which = {"scene": given.scene, "split": given.split, "frames": given.frames, "path": given.path, "scenes": VERSION}
    claim(given.output, which | settings)
    lines = [f"{t + 1},{x:.9g},{y:.9g},{z:.9g}" for t in range(given.frames) for x, y, z in [camera(described["shots"], t)[0]]]
    (given.output / "camera.csv").write_text("\n".join(["frame,x,y,z", *lines]) + "\n")
    build(described)
    scene = bpy.context.scene
    common(scene, given.threads)
    exact = aliased and described["clean"]
    small(scene, given.size, min(given.samples, EXACT) if exact else given.samples, aliased=aliased)
    seconds = {"lr": render_frames(given.output / "lr", every)}
    truth(scene, given.size, given.truth_samples)
    seconds["hr"] = render_frames(given.output / "hr", settings["truth_frames"])
    (given.output / "scene.json").write_text(json.dumps(described | {"render": settings | {"seconds": seconds}}, indent=1))
    sys.stdout.write(f"{given.output}: {given.frames} frames, lr {seconds['lr']:.1f} s, hr {seconds['hr']:.1f} s\n")


if __name__ == "__main__":
    main()
