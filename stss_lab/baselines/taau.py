# SPDX-License-Identifier: MIT
"""Temporal antialiasing with upsampling: the image shown before, moved along and corrected by the current frame."""

from __future__ import annotations

import numpy as np

from stss.images.resample import catmull_rom, enlarged, lanczos_centres
from stss_ref.arrays import Image, Mask
from stss_ref.frame import FrameInputs, NetworkInputs
from stss_ref.sample import follow, leads_inside

CURRENT = 0.1
"""Share of the current frame in the image shown."""


class Taau:
    """Accumulates at display resolution; frames must come in display order.

    ``shown_t(p) = h + 0.1 (current(p) - h)``, ``h = clamp(shown_{t-1}(p + motion(p)), box(p))``. ``current`` is the newest rendered frame,
    in an EF warped to now as the network gets it, upsampled by Lanczos's kernel and clamped to ``box``: the smallest and the
    largest value of each channel in the 3 x 3 low-resolution pixels around ``p``. Off screen, in the warping holes (of an SF: those of the
    second of its three colour frames), and where no earlier frame is within reach, ``current`` is shown: a cut starts it anew.

    Source: Karis, High Quality Temporal Supersampling, SIGGRAPH 2014; Lanczos and its clamping as in AMD's FSR 2. Frames are
    taken as they are: not jittered.
    """

    def __init__(self) -> None:
        self._shown: Image | None = None

    def __call__(self, inputs: FrameInputs, prepared: NetworkInputs) -> Image:
        """Compute the display frame that follows the last one computed.

        Args:
            inputs: of stage ``frame``; with all steps 0 there is no earlier frame.
            prepared: the network's inputs, made from ``inputs``.

        Returns:
            (2H, 2W, 3) display-referred.
        """
        low, high = _box(prepared.color[..., :3])
        shown = np.clip(lanczos_centres(prepared.color[..., :3]), low, high)
        # Only the first frame after a gap has no earlier one within reach, and so no step back.
        if max(inputs.steps) > 0 and self._shown is not None:
            at = follow(enlarged(2 * inputs.motions[0]))
            history = np.clip(catmull_rom(self._shown, at.x + at.fx, at.y + at.fy), low, high)  # a sum in float64
            keep = leads_inside(at) & enlarged(_seen_before(inputs, prepared))
            share = np.where(keep, np.float32(1 - CURRENT), np.float32(0))[..., None]
            shown += (history - shown) * share.astype(shown.dtype)
        self._shown = shown
        return shown


def _seen_before(inputs: FrameInputs, prepared: NetworkInputs) -> Mask:
    """(H, W) True where the newest of the earlier colour frames shows the same surface."""
    mask = prepared.history[1, ..., 3] if inputs.steps[0] == 0 else prepared.mask
    return mask != 0


def _box(image: Image) -> tuple[Image, Image]:
    """(2H, 2W, C) smallest and largest value of the 3 x 3 pixels of (H, W, C) around each pixel, as far as they lie in the frame."""
    height, width, _ = image.shape
    wide = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    around = np.stack([wide[j : j + height, i : i + width] for j in range(3) for i in range(3)])
    return enlarged(around.min(axis=0)), enlarged(around.max(axis=0))
