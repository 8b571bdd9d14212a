# SPDX-License-Identifier: MIT
"""Temporal antialiasing with upsampling: the image shown before, moved along and corrected by the current frame."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stss.images.resample import catmull_rom, lanczos_centres
from stss_ref.arrays import Image
from stss_ref.frame import FrameInputs, NetworkInputs
from stss_ref.sample import follow, leads_inside

CURRENT = 0.1
"""Share of the current frame in the image shown."""

Scalar = TypeVar("Scalar", bound=np.generic)


class Taau:
    """Accumulates at display resolution; frames must come in display order.

    ``shown_t(p) = h + 0.1 (current(p) - h)``, ``h = clamp(shown_{t-1}(p + motion(p)), box(p))``. ``current`` is the newest rendered frame,
    in an EF warped to now as the network gets it, upsampled by Lanczos's kernel and clamped to ``box``: the smallest and the
    largest value of each channel in the 3 x 3 low-resolution pixels around ``p``. Off screen, in the warping holes (of an SF: those of the
    second of its three colour frames), and where no earlier frame is within reach, ``current`` is shown: a cut starts it anew.

    With a jittered camera all that is of low resolution is read at ``p`` plus the frame's offset.

    Source: Karis, High Quality Temporal Supersampling, SIGGRAPH 2014; Lanczos and its clamping as in AMD's FSR 2.

    Args:
        jitter: the offset of each display frame's picture in low-resolution pixels (x right, y down), which motion has, too; in an EF
            that of its G-buffer. Without: none.
    """

    def __init__(self, jitter: Iterable[tuple[float, float]] = ()) -> None:
        self._shown: Image | None = None
        self._offsets, self._before = iter(jitter), (0.0, 0.0)

    def __call__(self, inputs: FrameInputs, prepared: NetworkInputs) -> Image:
        """Compute the display frame that follows the last one computed.

        Args:
            inputs: of stage ``frame``; with all steps 0 there is no earlier frame.
            prepared: the network's inputs, made from ``inputs``.

        Returns:
            (2H, 2W, 3) display-referred.
        """
        offset = next(self._offsets, (0.0, 0.0))
        low, high = (_nearest(edge, offset) for edge in _box(prepared.color[..., :3]))
        shown = np.clip(lanczos_centres(prepared.color[..., :3], offset), low, high)
        # Only the first frame after a gap has no earlier one within reach, and so no step back.
        if max(inputs.steps) > 0 and self._shown is not None:
            motion = inputs.motions[0] - np.subtract(self._before, offset, dtype=np.float32)
            at = follow(_nearest(2 * motion, offset))
            history = np.clip(catmull_rom(self._shown, at.x + at.fx, at.y + at.fy), low, high)  # a sum in float64
            # Where the newest of the earlier colour frames shows the same surface.
            seen = (prepared.history[1, ..., 3] if inputs.steps[0] == 0 else prepared.mask) != 0
            keep = leads_inside(at) & _nearest(seen, offset)
            share = np.where(keep, np.float32(1 - CURRENT), np.float32(0))[..., None]
            shown += (history - shown) * share.astype(shown.dtype)
        self._shown, self._before = shown, offset
        return shown


def _nearest(x: NDArray[Scalar], offset: tuple[float, float]) -> NDArray[Scalar]:
    """(2H, 2W, ...) of (H, W, ...): each display pixel has the pixel nearest to it."""
    across, down = (
        np.clip(np.rint((np.arange(2 * length) + 0.5) / 2 - 0.5 + shift), 0, length - 1).astype(np.intp)
        for length, shift in zip(x.shape[1::-1], offset, strict=True)
    )
    return x[down][:, across]


def _box(image: Image) -> tuple[Image, Image]:
    """(H, W, C) smallest and largest value of the 3 x 3 pixels of (H, W, C) around each pixel, as far as they lie in the frame."""
    height, width, _ = image.shape
    wide = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    around = np.stack([wide[j : j + height, i : i + width] for j in range(3) for i in range(3)])
    return around.min(axis=0), around.max(axis=0)
