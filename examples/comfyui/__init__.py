# SPDX-License-Identifier: MIT
"""Nodes for ComfyUI: load a renderer's frames, and make twice the size and twice the frame rate of them.

The colours of rendered frames go through the graph as images, so that other nodes may work on them. All else that the renderer wrote,
for every display frame, goes beside them as one value, `STSS_GBUFFER`.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import stss
from stss.frames.output import choose_rendered
from stss.images.color import transfer
from stss.sequence.antialiasing import judge_sampling
from stss.sequence.background import MOTION_SOURCES, MotionSource
from stss.sequence.choose_weights import AUTO, weights_for
from stss.sequence.find_files import find_frames
from stss.sequence.find_profile import settle_profile
from stss.sequence.profiles import profile_names
from stss.weights.file import SHIPPED
from stss_ground.errors import InputError
from stss_ref.schedule import schedule

Choices = dict[str, dict[str, tuple[Any, ...]]]


@dataclass(frozen=True)
class GBuffer:
    """Consecutive display frames without their colours, which of them were rendered, and the name of the weights that suit them."""

    frames: tuple[stss.Buffers, ...]
    rendered: tuple[bool, ...]
    weights: str


class LoadFrames:
    """A folder of EXR files, of any renderer that has a profile."""

    CATEGORY, FUNCTION = "stss", "load"
    RETURN_TYPES, RETURN_NAMES = ("IMAGE", "STSS_GBUFFER"), ("rendered frames", "gbuffer")
    OUTPUT_TOOLTIPS = "display-referred, without alpha", "all else of every display frame: for Supersample"
    DESCRIPTION = "Colours of the rendered frames, display-referred, and the G-buffer of every display frame."

    @classmethod
    def INPUT_TYPES(cls) -> Choices:  # noqa: N802
        """The inputs that ComfyUI shows."""
        return {
            "required": {
                "folder": ("STRING", {"default": "", "tooltip": "a folder, or a pattern like folder/name.####.exr"}),
                "profile": (["auto", *profile_names()], {"tooltip": "the renderer's conventions; auto: by the channels' names"}),
                "background": (list(MOTION_SOURCES), {"tooltip": "camera: for files without its motion, such as Blender's"}),
                "first": ("INT", {"default": 0, "min": 0, "max": 10**9, "tooltip": "a frame's number; 0: the first there is"}),
                "count": ("INT", {"default": 16, "min": 1, "max": 10_000, "tooltip": "display frames; 60 MiB each at 960 x 540"}),
            },
            # A workflow of a version without these goes on.
            "optional": {
                "static": (list(MOTION_SOURCES), {"tooltip": "camera: for files without motion, where only the camera moves"}),
                "roughness": ("FLOAT", _constant("roughness")),
                "metallic": ("FLOAT", _constant("metallic")),
                "camera": ("STRING", {"default": "", "tooltip": "a CSV file, frame,x,y,z; empty: from the files or positions"}),
            },
        }

    @classmethod
    def IS_CHANGED(cls, folder: str, profile: str, camera: str = "", **_: object) -> str:  # noqa: N802
        """Another value once a file is another one: the frames are then read again."""
        table = settle_profile(_path(folder), None if profile == "auto" else profile)
        frames = find_frames(_path(folder), table.endings)
        stats = [(n, path.stat()) for n in sorted(frames) for path in frames[n].values()]
        stats += [(-1, _path(camera).stat())] if camera.strip() else []
        return repr([(n, stat.st_mtime_ns, stat.st_size) for n, stat in stats])  # a copy may keep the time

    def load(
        self,
        folder: str,
        profile: str,
        background: MotionSource,
        first: int,
        count: int,
        static: MotionSource = "files",
        roughness: float = -1,
        metallic: float = -1,
        camera: str = "",
    ) -> tuple[Any, GBuffer]:
        """Read ``count`` display frames from the first rendered one on; the same ones count as rendered as in ``stss run``."""
        sequence = stss.open_sequence(
            _path(folder),
            None if profile == "auto" else profile,
            camera=_path(camera) if camera.strip() else None,
            metallic=None if metallic < 0 else metallic,
            roughness=None if roughness < 0 else roughness,
            background=background,
            static=static,
        )
        rendered = choose_rendered(sequence.numbers, sequence.rendered, None)
        start = min((n for n in rendered if n >= first), default=None)
        if start is None:
            raise InputError(f"{folder}: no rendered frame from {first} on")
        numbers = range(start, min(start + count, max(sequence.numbers) + 1))
        sequence.require(numbers)
        if lost := [n for n in numbers if schedule(n, rendered) is None]:
            advice = f"a count of {lost[0] - start} ends before it"
            raise InputError(f"{folder}: frame {lost[0]}: no rendered frame just before it to extrapolate from; {advice}")
        sampling = judge_sampling(sequence)
        logging.getLogger("stss").info("weights: auto takes %s (%s)", weights_for(sampling), sampling.reason)
        encode = transfer("srgb" if sequence.profile.color_domain == "linear" else "none").encode
        colors, frames, step = list[Any](), list[stss.Buffers](), _progress(len(numbers))
        for n in numbers:
            frame = sequence.crop_to_display(sequence.load(n, color=n in rendered, cut=n == start))
            colors += [] if frame.color is None else [encode(frame.color)]
            frames.append(replace(frame, color=None, carried={}))
            step()
        return _tensor(np.stack(colors)), GBuffer(tuple(frames), tuple(n in rendered for n in numbers), weights_for(sampling))


class Supersample:
    """Twice the size, and twice the frame rate."""

    CATEGORY, FUNCTION = "stss", "supersample"
    RETURN_TYPES, RETURN_NAMES = ("IMAGE", "MASK"), ("frames", "holes")
    OUTPUT_TOOLTIPS = "every display frame", "1 where an extrapolated frame saw a place for the first time; of the rendered size"
    DESCRIPTION = "Every display frame at twice the size."

    @classmethod
    def INPUT_TYPES(cls) -> Choices:  # noqa: N802
        """The inputs that ComfyUI shows."""
        return {
            "required": {
                "images": ("IMAGE", {"tooltip": "the rendered frames; other nodes may have changed them, but not their size"}),
                "gbuffer": ("STSS_GBUFFER", {"tooltip": "of the same frames, from Load rendered frames"}),
                "weights": (
                    [AUTO, *SHIPPED, "bilinear"],
                    {"tooltip": "auto: by the frames; realtime: aliased frames of engines; antialiased: of path tracers"},
                ),
                "backend": (["cl", "ref"], {"tooltip": "cl: OpenCL, on a GPU or the processor; ref: NumPy, slow"}),
            }
        }

    def supersample(self, images: Any, gbuffer: GBuffer, weights: str, backend: str) -> tuple[Any, Any]:
        """(B, 2H, 2W, 3) and (B, H, W) of all B display frames."""
        colors = np.asarray(images.cpu().numpy(), np.float32)
        (height, width), count, total = gbuffer.frames[0].size, sum(gbuffer.rendered), len(gbuffer.frames)
        if colors.shape != (count, height, width, 3):
            expected = f"{(count, height, width, 3)}; found {colors.shape}"
            raise InputError(f"images: expected the {count} rendered frames, {expected}")
        frames = np.empty((total, 2 * height, 2 * width, 3), np.float32)
        holes = np.empty((total, height, width), np.float32)
        loop = stss.Supersampler(gbuffer.weights if weights == AUTO else weights, backend=backend, transfer="none")
        step = _progress(total)
        for index, output in enumerate(loop(_with_colors(gbuffer, colors))):
            np.clip(output.image, 0, 1, out=frames[index])
            holes[index] = ~output.valid
            step()
        return _tensor(frames), _tensor(holes)


def _constant(buffer: str) -> dict[str, Any]:
    tooltip = f"for files without {buffer}, 0 to 1; -1: from the files"
    return {"default": -1.0, "min": -1.0, "max": 1.0, "step": 0.05, "tooltip": tooltip}


def _path(text: str) -> Path:
    """A folder as it was pasted: Windows copies a path with quotes."""
    if not (name := text.strip().strip('"')):
        raise InputError("folder: empty; expected a folder of EXR files, or a pattern like folder/name.####.exr")
    return Path(name).expanduser()


def _with_colors(gbuffer: GBuffer, colors: np.ndarray[Any, Any]) -> Iterator[stss.Buffers]:
    waiting = iter(colors)
    for frame, rendered in zip(gbuffer.frames, gbuffer.rendered, strict=True):
        yield replace(frame, color=np.clip(next(waiting), 0, 1)) if rendered else frame


def _tensor(array: np.ndarray[Any, Any]) -> Any:
    return importlib.import_module("torch").from_numpy(np.ascontiguousarray(array, np.float32))


def _progress(count: int) -> Callable[[], None]:
    """Call it after each frame: ComfyUI shows it, and ends here if the user stopped it. Without ComfyUI it does nothing."""
    try:
        update = importlib.import_module("comfy.utils").ProgressBar(count).update
    except ImportError:
        return lambda: None
    return lambda: update(1)


NODE_CLASS_MAPPINGS = {"StssLoadFrames": LoadFrames, "StssSupersample": Supersample}
NODE_DISPLAY_NAME_MAPPINGS = {"StssLoadFrames": "Load rendered frames (stss)", "StssSupersample": "Supersample (stss)"}
