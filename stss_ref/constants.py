# SPDX-License-Identifier: MIT
"""The constants of the specification that a port may want as parameters: every backend takes them from here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class HoleLimits:
    """The constants of the hole test (spec 4; ExtraNet).

    Attributes:
        facing: largest trusted distance on a surface seen head-on; cm.
        grazing: the same seen edge-on; cm.
        depth: what normalised depth 1 adds to both; cm.
        cosine: smallest trusted cosine between a moving object's normals.
        mesh: largest trusted value of ``3 |warped stencil - stencil|``.
    """

    facing: float = 7.5
    grazing: float = 45.0
    depth: float = 50.0
    cosine: float = 0.98
    mesh: float = 1.0
