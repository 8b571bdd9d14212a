# SPDX-License-Identifier: MIT
"""The cost of a film in Cycles at full size and rate, by samples, and at half of both with stss; and the quality of each.

Runs where Blender is a Python module (`pip install bpy`). stss runs as a separate program::

    python measure_saving.py shot.blend -o saving --frames 1 10 --samples 32 --truth 128 --stss .venv/bin/stss

Prints processor seconds of a frame, summed over all cores, and PSNR and SSIM against the truth: the mean of all frames. No frame is
denoised.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import shlex
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import bpy

EXTENSION = Path(__file__).resolve().parent


def extension() -> Any:
    """The module `film` of the extension, from its sources."""
    spec = importlib.util.spec_from_file_location(
        "stss_film", EXTENSION / "__init__.py", submodule_search_locations=[str(EXTENSION)]
    )
    if spec is None or spec.loader is None:
        raise FileNotFoundError(EXTENSION)
    sys.modules["stss_film"] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.film


def seconds(work: Callable[[], object]) -> float:
    """Processor seconds that the work takes, in this process and in those that it starts."""
    before = os.times()
    work()
    return sum(os.times()[:4]) - sum(before[:4])


def render_full(folder: Path, samples: int, seed: int) -> None:
    """The scene's frames as they are, with this number of samples a pixel."""
    scene = bpy.context.scene
    image, cycles = scene.render.image_settings, scene.cycles
    if hasattr(image, "media_type"):  # Blender 5
        image.media_type = "IMAGE"
    image.file_format, image.color_mode, image.color_depth, image.exr_codec = "OPEN_EXR", "RGB", "16", "ZIP"
    cycles.samples, cycles.seed = samples, seed
    for number in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(number)
        scene.render.filepath = str(folder / f"frame.{number:04d}.exr")
        bpy.ops.render.render(write_still=True)


def main() -> None:
    """Render the film in every way, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shot", type=Path, help="a .blend for Cycles")
    parser.add_argument("--frames", type=int, nargs=2, metavar=("FIRST", "LAST"), required=True)
    parser.add_argument(
        "--samples",
        type=int,
        default=32,
        help="samples a pixel of the small frames; the full frames have this number and its halves",
    )
    parser.add_argument("--truth", type=int, default=128, help="samples of the truth, which has another seed")
    parser.add_argument("--stss", default="stss", help="the command that starts stss")
    parser.add_argument("--options", default="", help="further options of stss run, such as --cuts")
    parser.add_argument("-o", "--out", type=Path, required=True, help="a new folder")
    options = parser.parse_args()
    console = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Blender's own lines
    options.out.mkdir(parents=True)
    out, command = options.out.resolve(), shlex.split(options.stss)
    bpy.ops.wm.open_mainfile(filepath=str(options.shot.resolve()))
    scene, film = bpy.context.scene, extension()
    scene.frame_start, scene.frame_end = first, last = options.frames
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    render_full(out / "warm", 1, 0)  # the first frames of a process load its kernels
    render_full(out / "truth", options.truth, 1)

    def row(name: str, folder: Path, took: float) -> None:
        result = subprocess.run(
            [*command, "compare", folder, out / "truth", "--json"], check=True, capture_output=True, text=True
        )
        frames = [frame["all"] for frame in json.loads(result.stdout)["frames"]]
        psnr, ssim = (sum(frame[key] for frame in frames) / len(frames) for key in ("psnr_rgb", "ssim"))
        print(f"{name}: {took / (last - first + 1):.2f} s, {psnr:.2f} dB, SSIM {ssim:.3f}", file=console, flush=True)

    count = 1
    while count <= options.samples:
        row(f"full-{count}", out / f"full-{count}", seconds(lambda: render_full(out / f"full-{count}", count, 0)))  # noqa: B023
        count *= 2
    scene.cycles.samples = options.samples
    first_frames, words = film.cuts_of(shlex.split(options.options))
    cuts: list[int] = []

    def render_half() -> Iterator[str]:
        cuts[:] = (yield from film.render(scene, out / "half", first_frames))[1]  # those of markers, too

    half = seconds(lambda: [*render_half()])
    stss_seconds = seconds(lambda: [*film.supersample(out / "half", cuts, command, words)])
    print(f"stss run alone: {stss_seconds / (last - first + 1):.2f} s", file=console)
    row("stss", out / "half" / "out", half + stss_seconds)


if __name__ == "__main__":
    try:
        main()
    except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
        sys.stderr.write(f"{getattr(error, 'stderr', None) or error}\n")
        sys.stderr.flush()
        os._exit(2)
    except Exception:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
    sys.stdout.flush()
    os._exit(0)  # Blender as a module may wait for ever when Python tidies up
