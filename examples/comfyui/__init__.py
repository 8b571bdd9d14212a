# SPDX-License-Identifier: MIT
"""Nodes for ComfyUI: load a renderer's frames, and make twice the size and twice the frame rate of them.

The colours of rendered frames go through the graph as images, so that other nodes may work on them. All else that the renderer wrote,
for every display frame, goes beside them as one value, `STSS_GBUFFER`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import stss
from stss.images.color import transfer
from stss.sequence.background import BACKGROUNDS, Background
from stss.sequence.find_files import find_frames
from stss.sequence.find_profile import settle_profile
from stss.sequence.profiles import profile_names
from stss.weights.file import SHIPPED
from stss_ground.errors import InputError

Choices = dict[str, dict[str, tuple[Any, ...]]]


@dataclass(frozen=True)
class GBuffer:
    """Consecutive display frames without their colours, and which of them were rendered."""

    frames: tuple[stss.Buffers, ...]
    rendered: tuple[bool, ...]


class LoadFrames:
    """A folder of EXR files, of any renderer that has a profile."""

    CATEGORY, FUNCTION = "stss", "load"
    RETURN_TYPES, RETURN_NAMES = ("IMAGE", "STSS_GBUFFER"), ("rendered frames", "gbuffer")
    DESCRIPTION = "Colours of the rendered frames, display-referred, and the G-buffer of every display frame."

    @classmethod
    def INPUT_TYPES(cls) -> Choices:  # noqa: N802
        """What ComfyUI shows."""
        return {
            "required": {
                "folder": ("STRING", {"default": "", "tooltip": "a folder, or a pattern like folder/name.####.exr"}),
                "profile": (["auto", *profile_names()],),
                "background": (list(BACKGROUNDS), {"tooltip": "camera: for files without its motion, such as Blender's"}),
                "first": ("INT", {"default": 0, "min": 0, "max": 10**9, "tooltip": "0: the first there is"}),
                "count": ("INT", {"default": 16, "min": 1, "max": 10_000, "tooltip": "display frames; 12 MiB each at 960 x 540"}),
            }
        }

    @classmethod
    def IS_CHANGED(cls, folder: str, profile: str, background: Background, first: int, count: int) -> str:  # noqa: N802
        """Another value once a file is another one: the frames are then read again."""
        table = settle_profile(_path(folder), None if profile == "auto" else profile)
        frames = find_frames(_path(folder), table.endings)
        return repr([(n, path.stat().st_mtime_ns) for n in sorted(frames) for path in frames[n].values()])

    def load(self, folder: str, profile: str, background: Background, first: int, count: int) -> tuple[Any, GBuffer]:
        """Read ``count`` display frames; every second one from the first rendered one counts as rendered."""
        sequence = stss.open_sequence(_path(folder), None if profile == "auto" else profile, background=background)
        start = min((n for n in sequence.rendered if n >= first), default=None)
        if start is None:
            raise InputError(f"{folder}: no rendered frame from {first} on")
        numbers = range(start, min(start + count, max(sequence.numbers) + 1))
        sequence.require(numbers)
        encode = transfer("srgb" if sequence.profile.color_domain == "linear" else "none").encode
        loaded = [sequence.load(n, color=(n - start) % 2 == 0) for n in numbers]
        colors = [encode(frame.color) for frame in loaded if frame.color is not None]
        rendered = tuple(frame.color is not None for frame in loaded)
        frames = tuple(replace(frame, color=None, carried={}) for frame in loaded)
        return _tensor(np.stack(colors)), GBuffer(frames, rendered)


class Supersample:
    """Twice the size, and twice the frame rate."""

    CATEGORY, FUNCTION = "stss", "supersample"
    RETURN_TYPES, RETURN_NAMES = ("IMAGE", "MASK"), ("frames", "holes")
    DESCRIPTION = "Every display frame at twice the size. Masks are 1 where an extrapolated frame saw a place for the first time."

    @classmethod
    def INPUT_TYPES(cls) -> Choices:  # noqa: N802
        """What ComfyUI shows."""
        return {
            "required": {
                "images": ("IMAGE", {"tooltip": "the rendered frames; other nodes may have changed them, but not their size"}),
                "gbuffer": ("STSS_GBUFFER",),
                "weights": (
                    [*SHIPPED, "bilinear"],
                    {"tooltip": "realtime: aliased frames of engines; antialiased: of path tracers"},
                ),
                "backend": (["cl", "ref"], {"tooltip": "cl: OpenCL, on a GPU or the processor; ref: NumPy, slow"}),
            }
        }

    def supersample(self, images: Any, gbuffer: GBuffer, weights: str, backend: str) -> tuple[Any, Any]:
        """(B, 2H, 2W, 3) and (B, H, W) of the B display frames that anything can be made for."""
        colors = np.asarray(images.cpu().numpy(), np.float32)
        size, count = gbuffer.frames[0].size, sum(gbuffer.rendered)
        if colors.shape != (count, *size, 3):
            raise InputError(f"images: expected the {count} rendered frames, {(count, *size, 3)}; found {colors.shape}")
        loop, step = stss.Supersampler(weights, backend=backend, transfer="none"), _progress(len(gbuffer.frames))
        outputs = [output for frame in _with_colors(gbuffer, colors) if (output := loop.push(frame)) is not None and step()]
        frames = np.stack([np.clip(output.image, 0, 1) for output in outputs])
        return _tensor(frames), _tensor(np.stack([~output.valid for output in outputs]).astype(np.float32))


def _path(text: str) -> Path:
    """A folder as it was pasted: Windows copies a path with quotes."""
    return Path(text.strip().strip('"'))


def _with_colors(gbuffer: GBuffer, colors: np.ndarray[Any, Any]) -> Iterator[stss.Buffers]:
    waiting = iter(colors)
    for frame, rendered in zip(gbuffer.frames, gbuffer.rendered, strict=True):
        yield replace(frame, color=np.clip(next(waiting), 0, 1)) if rendered else frame


def _tensor(array: np.ndarray[Any, Any]) -> Any:
    return importlib.import_module("torch").from_numpy(np.ascontiguousarray(array, np.float32))


def _progress(count: int) -> Callable[[], bool]:
    """Call it after each frame; without ComfyUI it does nothing."""
    try:
        update = importlib.import_module("comfy.utils").ProgressBar(count).update
    except ImportError:
        return lambda: True
    return lambda: update(1) is None


NODE_CLASS_MAPPINGS = {"StssLoadFrames": LoadFrames, "StssSupersample": Supersample}
NODE_DISPLAY_NAME_MAPPINGS = {"StssLoadFrames": "Load rendered frames (stss)", "StssSupersample": "Supersample (stss)"}
