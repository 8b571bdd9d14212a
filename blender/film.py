# SPDX-License-Identifier: MIT
"""Half the frames at half the size, and the G-buffer of all of them; then stss. Needs bpy; stss runs as a program of its own.

`render` and `supersample` are generators: each yields a line on how far it is, and between two of them Blender may draw and stop it.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Generator, Sequence
from contextlib import suppress
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
PACKAGES = Path(__file__).parent / "packages"
"""stss and its dependencies. Not in the manifest's list of wheels: Blender itself would then take our NumPy, and other add-ons with it."""
SUFFIXES = {".exr", ".png"}
POLL = 0.1
"""Seconds between two looks at the program, in which Blender does not draw."""
MARK = "stss-film"
"""Name of the file that tells a folder of ours from others."""


class FilmError(RuntimeError):
    """The scene cannot be rendered or supersampled; the message is one line."""


def render(scene: Any, folder: Path) -> Generator[str, None, list[str]]:
    """Write ``folder/lr/frame.NNNN.exr`` for every frame of the scene and ``folder/camera.csv``.

    The first frame and every second one after it have the scene's own samples; the others are rendered for their G-buffer only, and
    their colour is not used. Between frames and afterwards the scene's settings are as before, except for passes, AOVs and object
    numbers.

    Yields:
        A line before each frame.

    Returns:
        Lines for the user, see `passes.set_up`.

    Raises:
        FilmError: the engine is not Cycles, the scene has no camera, or the folder is somebody else's.
    """
    if scene.render.engine != "CYCLES":
        raise FilmError(f"expected the engine Cycles, found {scene.render.engine}: only Cycles writes the pass Vector")
    if scene.camera is None:
        raise FilmError("the scene has no camera")
    take(folder)
    warnings = set_up(scene, scene.view_layers[0])
    numbers, here = range(scene.frame_start, scene.frame_end + 1), scene.frame_current
    files = {number: folder / "lr" / f"frame.{number:04d}.exr" for number in numbers}
    (folder / "lr").mkdir(exist_ok=True)
    for old in {*(folder / "lr").glob("frame.*.exr")} - {*files.values()}:
        old.unlink()  # of an earlier render, which was longer
    try:
        write_camera(scene, numbers, folder / "camera.csv")
        for number, path in files.items():
            yield f"rendering frame {number}, {number - numbers[0] + 1} of {len(numbers)}"
            with changed(*_small(scene)):
                _frame(scene, number, path, colour=number % 2 == numbers[0] % 2)
    finally:
        scene.frame_set(here)
    return warnings


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


def supersample(folder: Path, first: int, command: Sequence[str] = (), options: Sequence[str] = ()) -> Generator[str, None, Path]:
    """Run ``stss run`` on the frames of `render`; its output goes to ``folder/out``. It ends with this generator.

    Args:
        folder: the folder of `render`.
        first: the first frame, which has colour.
        command: command that starts stss; empty: the one in this extension.
        options: more of ``stss run``.

    Yields:
        How many frames there are, every 0.1 s.

    Returns:
        The folder of the frames.

    Raises:
        FilmError: with the message of stss.
    """
    if not command and not (PACKAGES / "stss").is_dir():
        raise FilmError(f"{PACKAGES}: no stss: install the zip that build.py writes, or name a command in the preferences")
    out, total, rendered = folder / "out", len([*(folder / "lr").glob("frame.*.exr")]), "odd" if first % 2 else "even"
    words = [*(command or (sys.executable, "-P", "-m", "stss")), "run", str(folder / "lr"), "-o", str(out)]
    words += ["--profile", "blender", "--camera", str(folder / "camera.csv"), "--rendered", rendered, "--overwrite", *options]
    # Its own packages before those of Blender's Python. -P: no module beside the .blend is one of them.
    environment = os.environ if command else {**os.environ, "PYTHONPATH": str(PACKAGES)}
    before = _times(out)
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as messages:
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=messages, env=environment)
        try:
            while process.poll() is None:
                count = len(_times(out).items() - before.items())
                yield (
                    f"stss: {count} of {total} frames"
                    if count
                    else "stss starts; on a new machine it builds kernels for some minutes"
                )
                with suppress(subprocess.TimeoutExpired):
                    process.wait(POLL)
        finally:
            process.terminate()  # where the user stopped it; else it has ended
            process.wait()
        messages.seek(0)
        if process.returncode:
            raise FilmError((messages.read().strip() or f"stss ended with status {process.returncode}").splitlines()[-1])
    return out


def _times(out: Path) -> dict[Path, int]:
    """The frames of a folder, and when they were written."""
    return {path: path.stat().st_mtime_ns for path in out.glob("frame.*") if path.suffix in SUFFIXES}


def load(out: Path) -> Any:
    """The frames as one image sequence of Blender's, to be shown in an image editor or the compositor.

    Raises:
        FilmError: there are none.
    """
    files = sorted(_times(out))
    if not files:
        raise FilmError(f"{out}: no frames")
    image = bpy.data.images.load(str(files[0]), check_existing=True)
    image.source, image.name = "SEQUENCE", "stss"
    return image
