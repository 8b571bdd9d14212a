# SPDX-License-Identifier: MIT
"""Whether a frame's colour belongs to its G-buffer: both must have the same edges, equally strong."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from stss.check_sequence.value_statistics import Line
from stss.frames.buffers import Buffers
from stss_ref.arrays import Array, Image, Mask, Plane
from stss_ref.warp import warp

CLEARLY = 0.05
"""Another choice is better if its correlation is larger by this. Found: 0.2 and more with the G-buffer of another frame."""
DARK = 1e-3
"""Light below which edges do not count."""
SAME = 0.02
"""Normals of one flat surface differ by less in each component."""
PATTERN = 0.05
"""Least step of a base colour's logarithm that counts."""
MIN_STEPS = 500
"""Fewest such steps that allow a judgement."""
ENCODED = 0.65
"""Steps of the colour's logarithm over those of the base colour's. Found: 0.87 to 0.98 in linear colours, 0.42 to 0.46 in encoded ones."""
ENCODED_BASE = 1.4
"""The same of base colours that are encoded. Found: 1.88 to 2.16; in linear ones at most 0.98, as above."""
UNRELATED = 0.1
"""Steps of a colour that is not that of its base colours at all, such as black."""
OTHERWISE = (
    "the G-buffer is upside down, or the colour is",
    "the G-buffer is that of the previous frame",
    "the G-buffer is that of the frame after",
)


def alignment_lines(frames: Iterable[Buffers], *, linear: bool) -> list[Line]:
    """Findings about frames with a colour, one in memory at a time; ``linear``: the profile's statement about the colours."""
    ratios: list[Array] = []
    steps: list[Array] = []
    bright = False
    for frame in frames:
        if frame.color is not None:
            bright |= bool((frame.color > 1).any())
            ratios.append(_correlations(frame))
            steps.append(_steps(frame))
    if not ratios:
        return []
    if edges := _ratio_lines(ratios):
        return edges  # edges that are not its own say nothing of its light
    return _transfer_lines(np.concatenate(steps), linear=linear, bright=bright)


def _ratio_lines(ratios: list[Array]) -> list[Line]:
    own, *others = np.mean(ratios, axis=0)
    best = int(np.argmax(others))
    if not others[best] > own + CLEARLY:
        return []
    text = f"colour: its edges do not match those of base colour and normal; it looks as if {OTHERWISE[best]}"
    return [("warning", f"{text} (correlation {others[best]:.2f}, now {own:.2f})")]


def _transfer_lines(steps: Array, *, linear: bool, bright: bool) -> list[Line]:
    """On a flat surface light hardly changes: a linear colour changes as much as its base colour, an encoded one less."""
    if len(steps) < MIN_STEPS:
        return []
    slope = float(np.median(steps))
    if linear and slope > ENCODED_BASE:
        return [("warning", f"base_color: looks encoded for a display, beside the colours (power {slope:.2f}); expected linear")]
    if slope < UNRELATED or (slope > ENCODED) == linear or (linear and bright):  # a display shows nothing above 1
        return []
    looks, expected = ("encoded for a display", "linear") if linear else ("linear", "display-referred")
    return [("warning", f"colour: looks {looks}, beside its base colours (power {slope:.2f}); the profile says {expected}")]


def _steps(frame: Buffers) -> Array:
    """For neighbours on a flat surface with a pattern: the step of the colour's logarithm divided by that of the base colour's."""
    assert frame.color is not None
    color, base = (np.log(np.maximum(np.nan_to_num(of).mean(axis=-1), DARK)) for of in (frame.color, frame.base_color))
    hit, normal = np.isfinite(frame.depth) & (frame.normal != 0).any(axis=-1), np.nan_to_num(frame.normal)
    steps: list[Array] = []
    for axis in (0, 1):
        flat = np.abs(np.diff(normal, axis=axis)).max(axis=-1, initial=0) < SAME
        both = hit[1:] & hit[:-1] if axis == 0 else hit[:, 1:] & hit[:, :-1]
        mask = flat & both & (np.abs(np.diff(base, axis=axis)) > PATTERN)
        steps.append(np.diff(color, axis=axis)[mask] / np.diff(base, axis=axis)[mask])
    return np.concatenate(steps)


def _correlations(frame: Buffers) -> Array:
    """The correlations of the frame as it is, and as in `OTHERWISE`."""
    assert frame.color is not None
    visible = np.isfinite(frame.depth) & np.isfinite(frame.motion).all(axis=-1)
    color = _edges(np.log(np.maximum(np.nan_to_num(frame.color), DARK)))
    surfaces = _edges(np.nan_to_num(np.concatenate([frame.normal, frame.base_color], axis=-1)))
    moved = [warp(surfaces[..., None], sign * frame.motion) for sign in (1, -1)]
    choices = [
        (surfaces, visible),
        (surfaces[::-1], visible & visible[::-1]),
        *((w[..., 0], visible & inside) for w, inside in moved),
    ]
    return np.array([_correlation(color, edges, mask) for edges, mask in choices])


def _edges(image: Image) -> Plane:
    """(H, W) roots of the differences to the right and the lower neighbour, so that no single edge decides."""
    across, down = (np.abs(np.diff(image, axis=axis)).sum(axis=-1) for axis in (1, 0))
    return np.sqrt(np.pad(across, ((0, 0), (0, 1))) + np.pad(down, ((0, 1), (0, 0))))


def _correlation(a: Plane, b: Plane, mask: Mask) -> float:
    if not mask.any() or a[mask].std() == 0 or b[mask].std() == 0:
        return 0.0
    return float(np.corrcoef(a[mask], b[mask])[0, 1])
