# SPDX-License-Identifier: MIT
"""A display frame as a caller passes it."""

from __future__ import annotations

from typing import Protocol

from stss_ref.arrays import Array


class DisplayFrame(Protocol):
    """The arrays of a display frame (spec 0), float32. None of them may change while the frame is in the window of a call.

    Attributes:
        color: (H, W, 3) display-referred, in [0, 1]; None where the frame was not rendered.
        motion: (H, W, 2) pixels, current -> previous, x right, y down.
        gbuffer: (H, W, 9) normal 3, depth (normalised), roughness, metallic, base colour 3.
        nov: (H, W) dot of normal and view vector.
        stencil: (H, W) object number, 0 = static.
        position: (H, W, 3) world space; cm.
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
