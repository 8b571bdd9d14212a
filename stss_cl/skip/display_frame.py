# SPDX-License-Identifier: MIT
"""A display frame as a caller passes it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from stss_cl.device.buffers import Plain
from stss_ref.arrays import ArrayError, require_shape


class DisplayFrame(Protocol):
    """The arrays of a display frame (spec 0), on the host or on the device. None may change while it is in a call's window.

    All are float32; color, gbuffer, nov and stencil may each be float16 instead, with the bits of the same values in float32.

    Attributes:
        color: (H, W, 3) display-referred, in [0, 1]; None where the frame was not rendered.
        motion: (H, W, 2) pixels, current -> previous, x right, y down.
        gbuffer: (H, W, 9) normal 3, depth (normalised), roughness, metallic, base colour 3.
        nov: (H, W) dot of normal and view vector.
        stencil: (H, W) object number, 0 = static.
        position: (H, W, 3) world space; cm.
    """

    @property
    def color(self) -> Plain | None: ...  # noqa: D102
    @property
    def motion(self) -> Plain: ...  # noqa: D102
    @property
    def gbuffer(self) -> Plain: ...  # noqa: D102
    @property
    def nov(self) -> Plain: ...  # noqa: D102
    @property
    def stencil(self) -> Plain: ...  # noqa: D102
    @property
    def position(self) -> Plain: ...  # noqa: D102


PLANES = ("color", "motion", "gbuffer", "nov", "stencil", "position")


def require_window(window: Sequence[DisplayFrame]) -> None:
    """Raise ArrayError unless ``window`` is a sequence of display frames, one at least, whose ``nov`` has a size."""
    if not isinstance(window, Sequence) or not window:
        raise ArrayError(f"window: expected a sequence of display frames, one at least, got {type(window).__name__}")
    for number, frame in enumerate(window):
        lacking = [name for name in PLANES if not hasattr(frame, name)]
        if lacking:
            raise ArrayError(
                f"window[{number}]: expected a display frame, got a {type(frame).__name__} without {', '.join(lacking)}"
            )
        require_shape(f"window[{number}].nov", frame.nov, (None, None))
