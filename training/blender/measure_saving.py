# SPDX-License-Identifier: MIT
"""Time what Blender's extension saves: all frames at full size, against half of them at half the size plus stss.

Runs where `bpy` is installed; stss runs as a program of its own::

    python measure_saving.py --scene 7 --stss ".venv/bin/stss" -o saving && stss compare saving/stss/out saving/full
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shlex
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import bpy
from assemble import build
from render import common, quiet, render_frames, truth
from scenes import describe

EXTENSION = Path(__file__).resolve().parents[2] / "blender"


def extension() -> Any:
    """The extension's module `film`, from the sources beside this folder."""
    spec = importlib.util.spec_from_file_location(
        "stss_blender", EXTENSION / "__init__.py", submodule_search_locations=[str(EXTENSION)]
    )
    if spec is None or spec.loader is None:
        raise FileNotFoundError(EXTENSION)
    module = sys.modules["stss_blender"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.film


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=int, default=7, help="seed of the scene, of the split test  [default: 7]")
    parser.add_argument("--size", default="640x360", help="of the full frames  [default: 640x360]")
    parser.add_argument("--frames", type=int, default=16, help="[default: 16]")
    parser.add_argument("--samples", type=int, default=64, help="of a pixel, full or half the size  [default: 64]")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="of Blender  [default: all]")
    parser.add_argument("--stss", default="stss", help="the command that starts stss  [default: stss]")
    parser.add_argument("--options", default="", help="more of stss run")
    parser.add_argument("-o", "--output", type=Path, required=True, help="a folder that is not there")
    given = parser.parse_args()
    width, _, height = given.size.partition("x")
    if not (width.isdecimal() and height.isdecimal() and min(int(width), int(height)) >= 16):
        parser.error(f"--size: expected WIDTHxHEIGHT, at least 16x16, found {given.size!r}")
    if int(width) % 2 or int(height) % 2:
        parser.error(f"--size: expected even numbers, since half the size is rendered, found {given.size!r}")
    if given.frames < 2 or given.samples < 1 or given.threads < 1:
        parser.error("expected at least 2 frames, 1 sample and 1 thread")
    if given.output.exists():
        parser.error(f"{given.output}: there already; times of frames that were rendered before would be wrong")
    given.size = (int(width), int(height))
    return given


def main() -> None:
    """Render one scene both ways and print the seconds of each part."""
    given = arguments()
    film = extension()
    with quiet():
        build(describe(given.scene, "test", given.frames))
    scene = bpy.context.scene
    common(scene, given.threads)
    truth(scene, (given.size[0] // 2, given.size[1] // 2), given.samples)
    scene.frame_start, scene.frame_end = 1, given.frames
    with quiet():
        scene.frame_set(1)
        scene.render.filepath = str(given.output / "warm" / "up.exr")
        bpy.ops.render.render(write_still=True)  # the first render of a process loads its kernels
    full = render_frames(given.output / "full", range(1, given.frames + 1))
    start = time.monotonic()
    with quiet():
        film.render(scene, given.output / "stss")
    halves = time.monotonic() - start
    start = time.monotonic()
    film.supersample(given.output / "stss", 1, shlex.split(given.stss), shlex.split(given.options))
    ours = time.monotonic() - start
    rows = {
        "all frames at full size": full,
        "half of them at half the size, G-buffer of all": halves,
        "stss run, with its start": ours,
    }
    for name, seconds in rows.items():
        sys.stdout.write(f"{name:48} {seconds:8.3f} s {seconds / given.frames:8.3f} s a frame\n")
    sys.stdout.write(f"share of the full time: {(halves + ours) / full:.2f}\n")


if __name__ == "__main__":
    try:
        main()
    except Exception:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
    sys.stdout.flush()
    os._exit(0)  # Blender as a module may wait for ever when Python tidies up
