# SPDX-License-Identifier: MIT
"""The constants of the specification that a port may take as parameters: every backend takes them from here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

HoleTest = Literal["footprint", "paper"]
"""The hole test of static surfaces: by the pixel's footprint, or by the paper's limits in cm, with which the authors' weights were
trained (`stss_ref.holes.holes`)."""
HOLE_TESTS: tuple[HoleTest, ...] = get_args(HoleTest)
HoleFill = Literal["occlusion_warp", "reshade"]
"""The stage that fills the holes of the newest colour frame: the paper's (`stss_ref.occlusion_warp`), or the one that reads a hole's own
surface and like materials around it (`stss_ref.reshade`)."""
HOLE_FILLS: tuple[HoleFill, ...] = get_args(HoleFill)

EARLIER_SHARES = (0.25, 0.125)
"""The shares that stage ``accumulate`` takes of earlier images, newest first (decision 45)."""
SLOW = 4.0
"""Longest motion, in pixels, over which an earlier image has its whole share there."""


@dataclass(frozen=True)
class HoleLimits:
    """The constants of the hole test (spec 4; ExtraNet).

    Attributes:
        footprints: largest trusted distance on a static surface; footprints of the pixel. Its square must be exact in float32.
        facing: the paper's, on a surface seen head-on; cm.
        grazing: the paper's, on a surface seen edge-on; cm.
        depth: added to both for a normalised depth of 1; cm.
        cosine: smallest trusted cosine between a moving object's normals.
        static_cosine: the same of static geometry; the test by the footprint alone reads it.
        mesh: largest trusted value of ``3 |warped stencil - stencil|``.
    """

    footprints: float = 1.5
    facing: float = 7.5
    grazing: float = 45.0
    depth: float = 50.0
    cosine: float = 0.98
    static_cosine: float = 0.5
    mesh: float = 1.0
