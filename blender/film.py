# SPDX-License-Identifier: MIT
"""Half the frames at half the size, and the G-buffer of all of them; then stss. Needs bpy; stss runs as a separate program.

`render` and `supersample` are generators: each yields lines on the progress, and between two of them Blender may draw and stop it.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Generator, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import bpy

from .passes import COLUMNS, changed, layer_of, set_up, survey, write_camera

GBUFFER_SAMPLES = 4
"""Samples of frames that are not rendered: base colour and normals need few, light needs none."""
HARMLESS = {
    "--accumulate", "--also", "--backend", "--cuts", "--depth", "--device", "--format", "--frames", "--keep-going",
    "--memory-limit", "--metallic", "--no-accumulate", "--non-finite", "--precision", "--roughness", "--skip", "--static",
    "--transfer", "--weights",
}  # fmt: skip
"""Options of ``stss run`` that another person's scene may name, without a path: they read and write no further file."""
PACKAGES = Path(__file__).parent / "packages"
"""stss and its dependencies. Not in the manifest's list of wheels: Blender itself would then take our NumPy, and other add-ons with it."""
SUFFIXES = {".exr", ".png"}
POLL = 0.1
"""Seconds between two looks at the program, in which Blender does not draw."""
NO_WINDOW = getattr(subprocess, "CREATE_NO_WINDOW", 0)
"""Without it, on Windows, a program that is started from a window opens a console."""
MARK = "stss-film"
"""Name of the file that marks a folder of this extension."""


class FilmError(RuntimeError):
    """The scene cannot be rendered or supersampled; the message is one line."""


def render(
    scene: Any, folder: Path, cuts: Collection[int] = (), trial: Callable[[], Iterable[str]] = tuple
) -> Generator[str, None, tuple[list[str], list[int]]]:
    """Write ``folder/lr/frame.NNNN.exr`` for every frame of the scene and ``folder/camera.csv``.

    The first frame of each shot and every second one after it have the scene's own samples; the others are rendered for their
    G-buffer only, and their colour is not used. Between frames and afterwards the scene's settings are as before, except for passes,
    AOVs and object numbers.

    Args:
        scene: the scene.
        folder: new, empty or of an earlier render.
        cuts: frames at which shots begin, beside those at which a marker changes the camera.
        trial: called after the first frame: whatever fails need not wait for the last one.

    Yields:
        A line before each frame, and those of the trial.

    Returns:
        Lines for the user, see `passes.set_up`; and the first frames of all shots but the first.

    Raises:
        FilmError: the scene cannot be rendered in this way, or the folder holds other files.
    """
    require(scene, cuts)
    take(folder)
    layer = layer_of(scene)
    warnings = set_up(layer)
    numbers, here = range(scene.frame_start, scene.frame_end + 1), scene.frame_current
    files = {number: folder / "lr" / f"frame.{number:04d}.exr" for number in numbers}
    (folder / "lr").mkdir(exist_ok=True)
    for old in {*(folder / "lr").iterdir()} - {*files.values()}:
        if old.name.startswith(("frame.", ".frame.")):
            old.unlink()  # from an earlier render, which was longer or was stopped
    try:
        yield "looking at what moves"
        cameras = survey(scene, layer, numbers, half_size(scene))
        write_camera(cameras, folder / "camera.csv")
        switches = {cameras[i][0] for i in range(1, len(cameras)) if cameras[i][1] != cameras[i - 1][1]}
        starts = sorted(switches.union(cuts))
        keeps = (
            _has_plan(folder, f"{half_size(scene)} pixels, shots from {[numbers[0], *starts]}") and not scene.render.use_overwrite
        )
        for number, path in files.items():
            if keeps and path.is_file():
                continue
            yield f"rendering frame {number}, {number - numbers[0] + 1} of {len(numbers)}"
            start = max([numbers[0], *(cut for cut in starts if cut <= number)])
            with changed(*_small(scene, layer)):
                render_frame(scene, layer, number, path, colour=(number - start) % 2 == 0)
            if number == numbers[0]:
                yield from trial()
    finally:
        scene.frame_set(here)
    return warnings, starts


def require(scene: Any, cuts: Collection[int] = ()) -> None:
    """Check that the scene can be rendered, before an hour is spent on it.

    Raises:
        FilmError: it cannot.
    """
    if scene.render.engine != "CYCLES":
        raise FilmError(f"expected the engine Cycles, found {scene.render.engine}: only Cycles writes the pass Object Index")
    if scene.camera is None:
        raise FilmError("the scene has no camera")
    if any(camera.data.type == "ORTHO" for camera in _cameras(scene)):
        raise FilmError("Camera, Type: expected Perspective, found Orthographic: for it Cycles writes a wrong Vector pass")
    if layer_of(scene) is None:
        raise FilmError("no view layer has Use for Rendering on")
    if scene.render.use_multiview:
        raise FilmError("Stereoscopy: expected off; render a film for each eye, each with a camera of its own")
    if scene.frame_step != 1:
        raise FilmError(f"Frame Range, Step: expected 1, found {scene.frame_step}: motion leads to the frame just before")
    for cut in sorted(cuts):
        if not scene.frame_start < cut <= scene.frame_end:
            raise FilmError(f"Options: --cuts {cut}: expected frames of {scene.frame_start + 1} to {scene.frame_end}")


def _cameras(scene: Any) -> set[Any]:
    """The scene's camera, and those of its markers."""
    marked = {marker.camera for marker in scene.timeline_markers if marker.camera is not None and marker.frame <= scene.frame_end}
    return {scene.camera, *marked}


def list_unused(scene: Any) -> list[str]:
    """A line for each setting of the scene that the frames will not have."""
    render, edit, layer, lines = scene.render, scene.sequence_editor, layer_of(scene), []
    if render.use_motion_blur:
        lines.append("Motion Blur: not in these frames; with it Cycles writes no Vector pass")
    if any(camera.data.type != "PERSP" for camera in _cameras(scene)):
        lines.append("Camera, Panoramic: where it turns, every second frame shows the background of the frame before")
    if render.use_border:
        lines.append("Render Region: the frames are whole, since each takes colours from beyond the region of another")
    if any(other.use for other in scene.view_layers if other != layer):
        lines.append(f"view layers: {layer.name} alone is rendered")
    # Blender 5 has a group of nodes, and use_nodes for ever on.
    composited = scene.compositing_node_group is not None if hasattr(scene, "compositing_node_group") else scene.use_nodes
    if render.use_compositing and composited:
        lines.append("Compositor: not in these frames; let it read them as an image sequence")
    if render.use_sequencer and edit is not None and (edit.strips if hasattr(edit, "strips") else edit.sequences):
        lines.append("Sequencer: not in these frames; let it read them as a strip")
    if any(size % 2 for size in full_size(scene)):
        width, height = (size + size % 2 for size in full_size(scene))
        lines.append(f"size: the frames have {width} x {height} pixels, as only even sizes have a half")
    return lines


def full_size(scene: Any) -> tuple[int, int]:
    """Width and height of the frames that Blender renders."""
    render = scene.render
    return render.resolution_x * render.resolution_percentage // 100, render.resolution_y * render.resolution_percentage // 100


def half_size(scene: Any) -> tuple[int, int]:
    """Width and height of the frames that `render` writes."""
    width, height = full_size(scene)
    return (width + 1) // 2, (height + 1) // 2


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
    (folder / MARK).touch()


def _has_plan(folder: Path, plan: str) -> bool:
    """Whether the frames there are of the same size and shots; writes down that they are from now on."""
    text = f"The Blender extension of stss writes here: {plan}\n"
    before = (folder / MARK).read_text()
    (folder / MARK).write_text(text)
    return text == before


def split_words(command: str) -> list[str]:
    """The words of a command, as `stss_ground.shell` has them. ValueError: a quote is not closed."""
    words = shlex.shlex(command, posix=True)
    words.whitespace_split, words.commenters = True, ""
    if os.name == "nt":
        words.escape, words.quotes = "", '"'
    return list(words)


def harmless(options: str) -> list[str]:
    """The words of the options.

    Raises:
        FilmError: one is not of `HARMLESS`, or names a path.
    """
    try:
        words = split_words(options)
    except ValueError as error:
        raise FilmError(f"Options: {error}") from error
    for word in words:
        name = word.partition("=")[0]
        if word.startswith("-") and name not in HARMLESS:
            raise FilmError(f"Options: {name}: a scene may give only {', '.join(sorted(HARMLESS))}")
        if not {"/", "\\"}.isdisjoint(word) or word.endswith(".safetensors"):
            raise FilmError(f"Options: {word}: names a path, which a scene may not: it may come from a stranger")
    return words


def cuts_of(words: Sequence[str]) -> tuple[list[int], list[str]]:
    """The frames of ``--cuts``, and the other words.

    Raises:
        FilmError: they are no numbers.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--cuts", type=lambda text: [int(one) for one in text.split(",")], default=[])
    try:
        options, others = parser.parse_known_args(words)
    except argparse.ArgumentError as error:
        raise FilmError("Options: --cuts: expected numbers of frames, such as 120,301") from error
    return options.cuts, others


def _small(scene: Any, layer: Any) -> list[tuple[Any, str, Any]]:
    """Settings for half the size and multilayer files.

    Motion blur is off, since with it Cycles writes no Vector pass; compositor and sequencer are off, since they would put their picture in
    place of the passes, and write the small frames over the user's own files.
    """
    render, image = scene.render, scene.render.image_settings
    kind = [(image, "media_type", "MULTI_LAYER_IMAGE")] if hasattr(image, "media_type") else []  # Blender 5
    width, height = half_size(scene)
    return [
        (render, "resolution_x", width),
        (render, "resolution_y", height),
        (render, "resolution_percentage", 100),
        *(
            (render, name, False)
            for name in (
                "use_motion_blur",
                "use_border",
                "use_compositing",
                "use_sequencer",
                "use_single_layer",
                "use_file_extension",
            )
        ),
        *((other, "use", False) for other in scene.view_layers if other != layer),
        (render, "filepath", render.filepath),
        *kind,
        (image, "file_format", "OPEN_EXR_MULTILAYER"),
        (image, "color_depth", "16"),  # of colour; passes of data stay float
        (image, "exr_codec", "ZIP"),
    ]


def render_frame(scene: Any, layer: Any, number: int, path: Path, *, colour: bool) -> None:
    """One frame's file, whole or not there."""
    part = path.with_name(f".{path.name}.part")
    cycles = scene.cycles
    plain: list[tuple[Any, str, Any]] = [
        (cycles, "samples", GBUFFER_SAMPLES),
        (cycles, "max_bounces", 0),
        (cycles, "use_adaptive_sampling", False),
        (cycles, "use_denoising", False),
        (layer, "samples", 0),
    ]
    scene.frame_set(number)
    scene.render.filepath = str(part)
    try:
        with changed(*([] if colour else plain)):
            bpy.ops.render.render(write_still=True, scene=scene.name)
        # Blender says nothing of an EXR that was cut short. Where no second one fits, this one may not have fitted either.
        if shutil.disk_usage(path.parent).free < max(part.stat().st_size, 1):
            raise FilmError(f"{path.parent}: the disk is full")
        part.replace(path)
    except (RuntimeError, FileNotFoundError) as error:
        part.unlink(missing_ok=True)
        reason = str(error).strip() if isinstance(error, RuntimeError) else "Blender wrote no file"
        raise FilmError(f"frame {number}: {reason}") from error


def try_first(folder: Path, number: int, command: Sequence[str], options: Sequence[str]) -> Generator[str]:
    """Run ``stss run`` on the first frame of `render` alone, whose output is thrown away.

    Raises:
        FilmError: with the message of stss, on its options, device or weights.
    """
    with tempfile.TemporaryDirectory() as place:
        alone = Path(place)
        (alone / "lr").mkdir()
        shutil.copy(folder / "lr" / f"frame.{number:04d}.exr", alone / "lr")
        shutil.copy(folder / "camera.csv", alone)
        yield from supersample(alone, (), command, [*options, "--frames", f"{number}:{number}"])


def supersample(
    folder: Path, cuts: Sequence[int], command: Sequence[str] = (), options: Sequence[str] = ()
) -> Generator[str, None, tuple[Path, list[str]]]:
    """Run ``stss run`` on the frames of `render`; its output goes to ``folder/out``. It ends with this generator.

    Args:
        folder: the folder of `render`.
        cuts: the first frames of all shots but the first.
        command: command that starts stss; empty: the one in this extension.
        options: more of ``stss run``.

    Yields:
        How many frames there are, every 0.1 s.

    Returns:
        The folder of the frames, and the lines of stss.

    Raises:
        FilmError: with the message of stss.
    """
    if not command and not (PACKAGES / "stss").is_dir():
        raise FilmError(f"{PACKAGES}: no stss: install the zip that build.py writes, or name a command in the preferences")
    out, total = folder / "out", len([*(folder / "lr").glob("frame.*.exr")])
    words = [*(command or (sys.executable, "-P", "-m", "stss")), "run", str(folder / "lr"), "-o", str(out)]
    words += ["--profile", "blender", "--camera", str(folder / "camera.csv"), "--overwrite", *options]
    if COLUMNS[-1] in (folder / "camera.csv").read_text(encoding="utf-8").partition("\n")[0]:
        words += ["--background", "camera"]  # Cycles writes no motion there
    words += ["--cuts", ",".join(map(str, cuts))] if cuts else []
    # Our packages come before those of Blender's Python. -P: no module beside the .blend is imported.
    environment = os.environ if command else {**os.environ, "PYTHONPATH": str(PACKAGES)}
    before = _times(out)
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as messages:
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=messages, env=environment, creationflags=NO_WINDOW)
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
        lines = messages.read().splitlines()
    if process.returncode:
        raise FilmError(lines[-1] if lines else f"stss ended with status {process.returncode}")
    return out, lines


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
    image.reload()  # an earlier film's pixels may be in memory
    image.use_view_as_render = files[0].suffix == ".exr"  # linear: as Blender shows a render
    return image


def show(user: Any, first: int, count: int) -> None:
    """Let an image's user, such as an image editor, show each frame at its own place in the timeline."""
    user.frame_start, user.frame_offset, user.frame_duration, user.use_auto_refresh = first, first - 1, count, True
