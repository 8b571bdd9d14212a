# SPDX-License-Identifier: MIT
"""A display frame as a caller hands it over."""

from __future__ import annotations

from typing import Protocol

from stss_ref.arrays import Array


class DisplayFrame(Protocol):
    """What an engine gives for a display frame (spec 0), float32. Nothing of it may change while it is in the window of a call.

    Attributes:
        color: (H, W, 3), or None.
        motion: (H, W, 2).
        gbuffer: (H, W, 9).
        nov: (H, W).
        stencil: (H, W).
        position: (H, W, 3).
    """

    @property
    def color(self) -> Array | None: ...  # noqa: D102
    @property
    def motion(self) -> Array: ...  # noqa: D102
    @property
    def gbuffer(self) -> Array: ...  # noqa: D102
    @property
    def nov(self) -> Array: ...  # noqa: D102
    @property
    def stencil(self) -> Array: ...  # noqa: D102
    @property
    def position(self) -> Array: ...  # noqa: D102
