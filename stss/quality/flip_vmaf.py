# SPDX-License-Identifier: MIT
"""FLIP and VMAF, by other people's packages; both belong to the extra ``metrics``."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stss_ground.errors import InputError
from stss_ground.optional import require
from stss_ground.output.write_whole import tell_errors
from stss_ref.arrays import Image, Plane, require_shape

EXTRA = "metrics"
MODEL = "version=vmaf_v0.6.1"
"""VMAF's model, made for 1920 x 1080 at three screen heights; it is named because the filter's default may change."""

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Perceptual:
    """The metrics of other packages to take."""

    flip: bool = False
    vmaf: bool = False

    def require_packages(self) -> None:
        """Raise InputError unless their packages are installed; called before the work."""
        for name, is_asked in (("flip_evaluator", self.flip), ("imageio_ffmpeg", self.vmaf)):
            if is_asked:
                require(name, EXTRA)


NEITHER = Perceptual()


def flip_map(image: Image, truth: Image) -> Plane:
    """Map the visible difference of two images that a screen shows in turn, at 67 pixels a degree.

    Source: Andersson et al., FLIP: A Difference Evaluator for Alternating Images, 2020; their package ``flip-evaluator``.

    Args:
        image: (H, W, 3) display-referred, sRGB; clipped to [0, 1].
        truth: as ``image``.

    Returns:
        (H, W) in [0, 1]; 0 where nothing differs nearby.

    Raises:
        ArrayError: shapes differ.
        InputError: the package is not installed.
    """
    require_shape("image", image, (None, None, 3))
    require_shape("truth", truth, image.shape)
    flip = require("flip_evaluator", EXTRA)
    reference, test = (np.ascontiguousarray(np.clip(x, 0, 1), np.float32) for x in (truth, image))
    difference, _, _ = flip.evaluate(reference, test, "LDR", applyMagma=False)
    return np.asarray(difference, np.float64)[..., 0]


def vmaf_scores(frames: Iterable[Iterable[Bytes]]) -> list[float]:
    """Compute VMAF of each frame of a sequence; the whole sequence counts, since motion in the truth hides errors.

    Source: Netflix, VMAF, model ``vmaf_v0.6.1``, of the luma, by the filter ``libvmaf`` of the FFmpeg in ``imageio-ffmpeg``.

    Args:
        frames: in order, (image, truth) of each: (H, W, 3) 8-bit RGB, all of one size.

    Returns:
        The score of each frame, 0 to 100, higher is better; a little less than 100 for equal frames.

    Raises:
        InputError: the package is not installed, frames differ in size, or FFmpeg fails; the message has its last line.
    """
    try:
        ffmpeg = require("imageio_ffmpeg", EXTRA).get_ffmpeg_exe()
    except RuntimeError as error:  # a platform for which its wheels have no FFmpeg
        raise InputError(f"VMAF: {str(error).splitlines()[0]}") from None
    with tempfile.TemporaryDirectory(prefix="stss-vmaf-") as name:
        folder = Path(name)
        with tell_errors(folder):
            height, width = _write_raw(folder, frames)
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-video_size", f"{width}x{height}", "-framerate", "60"]
        planes = "format=yuv444p"
        graph = f"[0]{planes}[a];[1]{planes}[b];[a][b]libvmaf=model={MODEL}:log_fmt=json:log_path=log.json"
        inputs = [*source, "-i", "image.rgb", *source, "-i", "truth.rgb"]
        command = [ffmpeg, "-hide_banner", "-loglevel", "error", *inputs, "-lavfi", graph, "-f", "null", "-"]
        process = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
        if process.returncode != 0 or not (folder / "log.json").exists():
            messages = process.stderr.strip().splitlines() or ["no reason given"]
            raise InputError(f"VMAF: FFmpeg failed: {messages[-1]}")
        log = json.loads((folder / "log.json").read_text())
    return [float(frame["metrics"]["vmaf"]) for frame in log["frames"]]


def _write_raw(folder: Path, frames: Iterable[Iterable[Bytes]]) -> tuple[int, int]:
    """Write ``image.rgb`` and ``truth.rgb``, frame after frame, uncompressed; returns their size (H, W)."""
    size: tuple[int, ...] = (0, 0)
    with (folder / "image.rgb").open("wb") as image_file, (folder / "truth.rgb").open("wb") as truth_file:
        for frame in frames:
            for file, image in zip((image_file, truth_file), frame, strict=True):
                size = image.shape[:2] if size == (0, 0) else size
                if image.shape[:2] != size:
                    raise InputError(f"VMAF: expected frames of one size, found {size} and {image.shape[:2]}")
                file.write(np.ascontiguousarray(image).tobytes())
    return size[0], size[1]
