# SPDX-License-Identifier: MIT
"""Temporal antialiasing with upsampling: the previous image, moved by motion and corrected by the current frame."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stss.images.resample import catmull_rom, lanczos_centres
from stss_ref.accumulate import box
from stss_ref.arrays import Image, Plane
from stss_ref.frame import FrameInputs, NetworkInputs
from stss_ref.sample import follow, leads_inside

MOST = 24
"""The history's largest weight, in frames."""
LEAST = 0.25
"""Least trust in the current frame, far from its samples."""

Scalar = TypeVar("Scalar", bound=np.generic)


class Taau:
    """Accumulates at display resolution; frames must come in display order.

    ``shown_t(p) = h + max(trust(p) / n(p), 1 / 24) (current(p) - h)``, ``h = clamp(shown_{t-1}(p + motion(p)), box(p))``. ``current``
    is the newest rendered frame, in an EF warped to the current one as for the network, upsampled by Lanczos's kernel and clamped to
    ``box``: the smallest and the largest value of each channel in the 3 x 3 low-resolution pixels around ``p``. ``trust`` is 1 where a
    sample lies and falls to 0.25 with the distance in low-resolution pixels; ``n`` counts the frames in ``h``, at most 24, and moves with
    the image. Off screen, where no earlier frame is within reach, and without jitter in the warping holes (of an SF: those of the second
    of its three colour frames), only ``current`` is shown: a cut starts a new history. With jitter the hole test marks many visible
    pixels as holes, and the box is enough.

    With a jittered camera all planes of low resolution are read at ``p`` plus the frame's offset.

    Source: Karis, High Quality Temporal Supersampling, SIGGRAPH 2014; Lanczos, its clamping, trust and count as in AMD's FSR 2.

    Args:
        jitter: the offset of each display frame's image in low-resolution pixels (x right, y down), which motion includes; in an EF
            that of its G-buffer. Empty: no jitter.
    """

    def __init__(self, jitter: Iterable[tuple[float, float]] = ()) -> None:
        self._history: Image | None = None  # (2H, 2W, 4): colour, and how many frames are in it
        offsets = tuple(jitter)
        self._offsets, self._jittered, self._before = iter(offsets), bool(offsets), (0.0, 0.0)

    def __call__(self, inputs: FrameInputs, prepared: NetworkInputs) -> Image:
        """Compute the display frame that follows the last one computed.

        Args:
            inputs: of stage ``frame``; with all steps 0 there is no earlier frame.
            prepared: the network's inputs, made from ``inputs``.

        Returns:
            (2H, 2W, 3) display-referred.
        """
        offset = next(self._offsets, (0.0, 0.0))
        low, high = (_nearest(edge, offset) for edge in box(prepared.color[..., :3]))
        image = np.clip(lanczos_centres(prepared.color[..., :3], offset), low, high)
        count = np.ones((*image.shape[:2], 1), np.float32)
        # Only the first frame after a gap has no earlier one within reach, and so no step back.
        if max(inputs.steps) > 0 and self._history is not None:
            motion = inputs.motions[0] - np.subtract(self._before, offset, dtype=np.float32)
            at = follow(_nearest(2 * motion, offset))
            before = catmull_rom(self._history, at.x + at.fx, at.y + at.fy)  # a sum in float64
            # Where the newest of the earlier colour frames shows the same surface.
            visible = (prepared.history[1, ..., 3] if inputs.steps[0] == 0 else prepared.mask) != 0
            keep = (leads_inside(at) & (_nearest(visible, offset) | self._jittered))[..., None]
            history = np.clip(before[..., :3], low, high)
            count = np.where(keep, np.clip(before[..., 3:], 0, MOST - 1) + 1, 1)
            share = np.where(keep, np.maximum(_trust(image.shape[:2], offset)[..., None] / count, 1 / MOST), 1)
            image = (history + (image - history) * share).astype(image.dtype)
        self._history, self._before = np.concatenate([image, count], axis=-1, dtype=np.float32), offset
        return image


def _trust(size: tuple[int, int], offset: tuple[float, float]) -> Plane:
    """(2H, 2W) how near each display pixel is to a sample of the frame: 1 less the distance in low-resolution pixels, at least `LEAST`."""
    down, across = (
        np.abs(place - np.clip(np.rint(place), 0, length // 2 - 1))
        for place, length in ((_places(length, shift), length) for length, shift in zip(size, offset[::-1], strict=True))
    )
    return np.clip(1 - np.hypot(down[:, None], across[None]), LEAST, 1)


def _places(length: int, shift: float) -> Plane:
    """(length,) where display pixels lie among low-resolution ones, along an axis."""
    return (np.arange(length) + 0.5) / 2 - 0.5 + shift


def _nearest(x: NDArray[Scalar], offset: tuple[float, float]) -> NDArray[Scalar]:
    """(2H, 2W, ...) of (H, W, ...): each display pixel has the pixel nearest to it."""
    across, down = (
        np.clip(np.rint(_places(2 * length, shift)), 0, length - 1).astype(np.intp)
        for length, shift in zip(x.shape[1::-1], offset, strict=True)
    )
    return x[down][:, across]
