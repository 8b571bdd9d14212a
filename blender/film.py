# SPDX-License-Identifier: MIT
"""Half the frames at half the size, and the G-buffer of all of them; then stss. Needs bpy; stss runs as a program of its own."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bpy

from .passes import changed, set_up, write_camera

GBUFFER_SAMPLES = 4
"""Samples of frames that are not rendered: base colour and normals need few, light needs none."""
HARMLESS = {
    "--backend", "--cuts", "--depth", "--device", "--format", "--frames", "--keep-going", "--memory-limit",
    "--metallic", "--non-finite", "--precision", "--roughness", "--skip", "--transfer", "--weights",
}  # fmt: skip
"""Options of ``stss run`` that a scene of somebody else may name, if they name no path: they read and write no further file."""
MARK = "stss-film"
"""Name of the file that tells a folder of ours from others."""


class FilmError(RuntimeError):
    """The scene cannot be rendered or supersampled; the message is one line."""


def render(scene: Any, folder: Path, on_frame: Callable[[int], None] = lambda number: None) -> list[str]:
    """Write ``folder/lr/frame.NNNN.exr`` for every frame of the scene and ``folder/camera.csv``.

    The first frame and every second one after it have the scene's own samples; the others are rendered for their G-buffer only, and
    their colour is not used. Afterwards the scene's settings are as before, except for passes, AOVs and object numbers.

    Returns:
        Lines for the user, see `stss.passes.set_up`.

    Raises:
        FilmError: the engine is not Cycles, the scene has no camera, or the folder is somebody else's.
    """
    if scene.render.engine != "CYCLES":
        raise FilmError(f"expected the engine Cycles, found {scene.render.engine}: only Cycles writes the pass Vector")
    if scene.camera is None:
        raise FilmError("the scene has no camera")
    take(folder)
    told = set_up(scene, scene.view_layers[0])
    (folder / "lr").mkdir(exist_ok=True)
    numbers, here = range(scene.frame_start, scene.frame_end + 1), scene.frame_current
    try:
        write_camera(scene, numbers, folder / "camera.csv")
        with changed(*_small(scene)):
            for number in numbers:
                _frame(scene, number, folder / "lr" / f"frame.{number:04d}.exr", colour=number % 2 == numbers[0] % 2)
                on_frame(number)
    finally:
        scene.frame_set(here)
    return told


def take(folder: Path) -> None:
    """Make the folder, or take that of an earlier render.

    Raises:
        FilmError: it holds other files.
    """
    if (folder / MARK).is_file():
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FilmError(f"{folder}: holds files that no render of this extension wrote; expected an empty folder")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MARK).write_text("The Blender extension of stss writes here.\n")


def harmless(options: str) -> list[str]:
    """The words of the options.

    Raises:
        FilmError: one is not of `HARMLESS`, or names a path.
    """
    try:
        words = shlex.split(options)
    except ValueError as error:
        raise FilmError(f"Options: {error}") from error
    for word in words:
        name = word.partition("=")[0]
        if (word.startswith("-") and name not in HARMLESS) or not {"/", "\\"}.isdisjoint(word) or word.endswith(".safetensors"):
            raise FilmError(f"Options: {word}: expected no path, and some of {', '.join(sorted(HARMLESS))}")
    return words


def _small(scene: Any) -> list[tuple[Any, str, Any]]:
    """Settings for half the size and multilayer files; motion blur is off, since with it Cycles writes no Vector pass."""
    image = scene.render.image_settings
    kind = [(image, "media_type", "MULTI_LAYER_IMAGE")] if hasattr(image, "media_type") else []  # Blender 5
    return [
        (scene.render, "resolution_percentage", max(1, scene.render.resolution_percentage // 2)),
        (scene.render, "use_motion_blur", False),
        (scene.render, "use_file_extension", False),
        (scene.render, "filepath", scene.render.filepath),
        *kind,
        (image, "file_format", "OPEN_EXR_MULTILAYER"),
        (image, "color_depth", "16"),  # of colour; passes of data stay float
        (image, "exr_codec", "ZIP"),
    ]


def _frame(scene: Any, number: int, path: Path, *, colour: bool) -> None:
    """One frame's file, whole or not there."""
    part = path.with_name(f".{path.name}.part")
    cycles = scene.cycles
    plain: list[tuple[Any, str, Any]] = [
        (cycles, "samples", GBUFFER_SAMPLES),
        (cycles, "max_bounces", 0),
        (cycles, "use_adaptive_sampling", False),
        (cycles, "use_denoising", False),
    ]
    scene.frame_set(number)
    scene.render.filepath = str(part)
    with changed(*([] if colour else plain)):
        bpy.ops.render.render(write_still=True, scene=scene.name)
    part.replace(path)


def supersample(folder: Path, first: int, command: Sequence[str] = (), options: Sequence[str] = ()) -> Path:
    """Run ``stss run`` on the frames of `render`; its output goes to ``folder/out``.

    Args:
        folder: the folder of `render`.
        first: the first frame, which has colour.
        command: command that starts stss; empty: the one in this extension's wheels.
        options: more of ``stss run``.

    Raises:
        FilmError: with what stss said.
    """
    rendered = "odd" if first % 2 else "even"
    words = [*(command or (sys.executable, "-P", "-m", "stss")), "run", str(folder / "lr"), "-o", str(folder / "out")]
    words += ["--profile", "blender", "--camera", str(folder / "camera.csv"), "--rendered", rendered, "--overwrite", *options]
    # The wheels of an extension lie where only this process looks for them. -P: no module beside the .blend is one of them.
    environment = os.environ if command else {**os.environ, "PYTHONPATH": os.pathsep.join(filter(os.path.isabs, sys.path))}
    done = subprocess.run(words, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        raise FilmError((done.stderr.strip() or "stss ended without a word").splitlines()[-1])
    return folder / "out"


def load(out: Path) -> Any:
    """The frames as one image sequence of Blender's, to be shown in an image editor or the compositor.

    Raises:
        FilmError: there are none.
    """
    files = sorted(out.glob("frame.*.exr"))
    if not files:
        raise FilmError(f"{out}: no frames")
    image = bpy.data.images.load(str(files[0]), check_existing=True)
    image.source, image.name = "SEQUENCE", "stss"
    return image
