# SPDX-License-Identifier: MIT
"""Whether motion follows the profile's convention: the previous frame is warped under every choice of signs and order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stss.frames.buffers import Buffers
from stss_ground.cores import for_blocks
from stss_ref.arrays import Image, Mask, Plane
from stss_ref.warp import warp

MOVING = 0.25
"""Least motion of a pixel that counts; pixels."""
MIN_PIXELS = 200
"""Fewest pixels that must tell the choices apart."""
VISIBLE = 1e-3
"""A pixel tells choices apart when their errors differ by this share of the largest value."""
MARGIN = 0.8
"""Another choice is better when its error is below this share of the profile's."""

CHOICES = {
    "as the profile says": (False, 1, 1),
    "x negated": (False, -1, 1),
    "y negated": (False, 1, -1),
    "x and y negated": (False, -1, -1),
    "x and y swapped": (True, 1, 1),
    "x and y swapped, then x negated": (True, -1, 1),
    "x and y swapped, then y negated": (True, 1, -1),
    "x and y swapped, then both negated": (True, -1, -1),
}
"""Choice -> (swap, sign of x, sign of y), applied to the stored motion in the profile's conventions."""


@dataclass(frozen=True)
class ConventionVerdict:
    """The errors of the previous frame's base colour and normal, warped under each choice: these planes are free of shading.

    Attributes:
        pixels: how many pixels told the choices apart; 0: too few.
        error: the profile's choice: median absolute difference over those pixels, relative to the largest value.
        ratios: choice -> its median error divided by the profile's, over the pixels where the two differ; choices that
            differ at too few pixels are left out.
    """

    pixels: int
    error: float
    ratios: dict[str, float]

    @property
    def better(self) -> str | None:
        """The choice that is clearly better than the profile's, or None."""
        best = min(self.ratios, key=lambda choice: self.ratios[choice], default=None)
        return best if best is not None and self.ratios[best] < MARGIN else None


def judge_motion(pairs: Iterable[tuple[Buffers, Buffers]]) -> ConventionVerdict:
    """Compare the eight choices over pairs of neighbouring frames (t - 1, t), one pair in memory at a time."""
    parts = [samples for before, now in pairs if len(samples := _differences(before, now)) >= MIN_PIXELS]
    if not parts:
        return ConventionVerdict(0, 0.0, {})
    together = np.concatenate(parts)
    ratios: dict[str, float] = {}
    for choice, error in zip(CHOICES, together.T, strict=True):
        differ = np.abs(error - together[:, 0]) > VISIBLE
        if differ.sum() >= MIN_PIXELS:
            medians = np.median(error[differ]), np.median(together[differ, 0])
            ratios[choice] = float(medians[0] / max(medians[1], VISIBLE * VISIBLE))
    return ConventionVerdict(len(together), float(np.median(together[:, 0])), ratios)


def _differences(before: Buffers, now: Buffers) -> Image:
    """(pixels, choices): mean absolute difference at the pixels that move and tell the choices apart."""
    earlier, current = (np.concatenate([frame.base_color, frame.normal], axis=-1) for frame in (before, now))
    with np.errstate(over="ignore", invalid="ignore"):
        usable = np.isfinite(now.depth) & (np.sqrt((now.motion.astype(np.float64) ** 2).sum(axis=-1)) > MOVING)
    choices = list(CHOICES.values())

    def differ(of: slice) -> tuple[Plane, Mask]:
        swap, x, y = choices[of.start]
        motion = (now.motion[..., ::-1] if swap else now.motion) * np.array((x, y), dtype=np.float32)
        warped, inside = warp(earlier, motion)
        return np.abs(warped - current).mean(axis=-1), inside

    errors, insides = zip(*for_blocks(len(choices), 1, differ), strict=True)
    usable &= np.logical_and.reduce(insides)
    if not usable.any():
        return np.zeros((0, len(CHOICES)), dtype=np.float32)
    stack = np.stack(errors, axis=-1)[usable] / np.abs(current[usable]).max()
    return stack[np.ptp(stack, axis=-1) > VISIBLE]
