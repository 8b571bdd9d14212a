# SPDX-License-Identifier: MIT
"""Changes since the previous frame, compared with those of the truth: flicker along the motion, and tPSNR. See docs/metrics.md."""

from __future__ import annotations

import numpy as np

from stss.frames.display_frame import DisplayFrame, make_display_frame, same_surface
from stss.images.color import transfer
from stss.images.resample import enlarge
from stss.sequence.background import CameraError
from stss.sequence.sequence import Sequence
from stss_ref.arrays import Image, Mask
from stss_ref.sample import follow, leads_inside
from stss_ref.warp import warp

OutputAndTruth = tuple[Image, Image]
"""Output and truth, (H, W, 3) display-referred, in [0, 1], not cut to 8 bits."""


def temporal_psnr(frame: OutputAndTruth, before: OutputAndTruth) -> float:
    """tPSNR: ``10 log10(1 / mean (d - d*)^2)``, ``d`` the change of the output pixel by pixel and without motion, ``d*`` that of the truth.

    Source: arm/neural-graphics-model-gym, ``src/ng_model_gym/core/evaluator/metrics.py``, commit 028eaa7, ``calculate_tpsnr``.

    Returns:
        dB, infinite where the changes agree.
    """
    image, truth = (now.astype(np.float64) - earlier for now, earlier in zip(frame, before, strict=True))
    error = float(((image - truth) ** 2).mean())
    return float(-10 * np.log10(error)) if error else float("inf")


class Follower:
    """Follows surfaces from frame to frame by the motion and the G-buffer of the frames that outputs were made from."""

    def __init__(self, sequence: Sequence):
        self._sequence = sequence
        self._last: DisplayFrame | None = None

    def flicker(self, number: int, frame: OutputAndTruth, before: OutputAndTruth) -> float | None:
        """The difference of the change of frame ``number`` since the one before it from the truth's: ``mean |d - d*|``.

        ``d(p) = out_t(p) - out_{t-1}(p + motion_t(p))``, and ``d*`` is the same of the truth. The mean is over the pixels whose motion
        leads into the frame and to the same surface (spec 4). Motion and holes come from the low-resolution G-buffer, whose pixels
        stand for four each.

        Returns:
            8-bit levels; None where nothing could be followed, or the sequence lacks one of the two frames or their cameras.
        """
        if not {number - 1, number} <= self._sequence.frames.keys():
            return None
        last = self._last
        earlier = last if last is not None and last.number == number - 1 else self._load(number - 1, cut=True)
        try:
            self._last = now = self._load(number)
        except CameraError:  # of a frame before a cut, say
            return None
        motion, followed = display_motion(earlier, now)
        d, d_true = ((new - warp(old, motion)[0])[followed] for old, new in zip(before, frame, strict=True))
        return 255 * float(np.abs(d - d_true).mean(dtype=np.float64)) if d.size else None

    def _load(self, number: int, *, cut: bool = False) -> DisplayFrame:
        buffers = self._sequence.crop_to_display(self._sequence.load(number, color=False, cut=cut))
        return make_display_frame(buffers, transfer("none"), self._sequence.profile.depth_normalisation)


def display_motion(before: DisplayFrame, now: DisplayFrame) -> tuple[Image, Mask]:
    """Bring the motion between two frames to display resolution, and find where it can be followed.

    Args:
        before: the earlier frame, (H, W).
        now: the one after it.

    Returns:
        motion: (2H, 2W, 2) display pixels, now -> before.
        followed: (2H, 2W) True where it leads to the same surface within the frame.
    """
    motion = enlarge(2 * now.motion)
    return motion, enlarge(same_surface(before, now)) & leads_inside(follow(motion))
