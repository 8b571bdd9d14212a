# SPDX-License-Identifier: MIT
"""Display frames of the canonical scenes (``conformance.scenes``), as an engine would deliver them, and their truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from conformance.scenes import SCENES, Scene, render
from stss.frames.buffers import Buffers
from stss.frames.display_frame import DisplayFrame, make_display_frame
from stss.images.color import transfer
from stss.sequence.conventions import BACKGROUND_POSITION
from stss_ground.errors import InputError
from stss_ref.arrays import Image

TRANSFER = "srgb"
TRUTH_SAMPLES = 9
"""Rays for each pixel of the truth."""


def check_request(scenes: Sequence[str], count: int, least: int) -> None:
    """Check the user's --scenes and --frames.

    Raises:
        InputError: there is no such scene, or there are fewer frames than ``least``.
    """
    for name in scenes:
        if name not in SCENES:
            raise InputError(f"--scenes: expected some of {', '.join(SCENES)}, got {name!r}")
    if count < least:
        raise InputError(f"--frames: expected at least {least}, got {count}")


def display_frames(scene: Scene, size: tuple[int, int], count: int) -> Iterator[DisplayFrame]:
    """The first ``count`` display frames at (height, width), new arrays each; the even ones are rendered."""
    curve = transfer(TRANSFER)
    for number in range(count):
        view = render(scene, number, *size)
        planes: dict[str, Any] = {n: getattr(view, n).astype(np.float32) for n in view.__dataclass_fields__}
        background = np.isinf(planes["depth"])[..., None]
        planes["position"] = np.where(background, np.float32(BACKGROUND_POSITION), planes["position"])
        color = planes.pop("color") if number % 2 == 0 else None
        planes.pop("color", None)
        yield make_display_frame(Buffers(number=number, color=color, **planes), curve, "scale")


def truth(scene: Scene, size: tuple[int, int], number: int) -> Image:
    """Display frame ``number`` at twice the size, (2H, 2W, 3) display-referred."""
    doubled = 2 * size[0], 2 * size[1]
    return transfer(TRANSFER).encode(render(scene, number, *doubled, samples=TRUTH_SAMPLES).color)
