# SPDX-License-Identifier: MIT
"""One display frame, as every profile delivers it and every backend expects it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from stss_ref.arrays import Array


@dataclass(frozen=True)
class Buffers:
    """The buffers of one display frame, float32, channels last, in the conventions of spec section 0.

    Attributes:
        number: the frame's number in the sequence.
        color: (H, W, 3) colour as it came from the renderer, before any transfer; None where the frame was not rendered.
        motion: (H, W, 2) low-resolution pixels, current -> previous, x right, y down; non-finite is off screen.
        normal: (H, W, 3) world space; 0 where nothing was hit. Renderers average it over samples: not always unit.
        depth: (H, W) linear view depth, > 0; infinite where nothing was hit. Any unit: it is normalised later.
        position: (H, W, 3) world position in cm, one far place where nothing was hit;
            NaN marks a pixel whose colour later frames must not trust.
        stencil: (H, W) object number; 0 = static geometry.
        nov: (H, W) dot of world normal and view vector.
        base_color: (H, W, 3) in [0, 1], linear.
        roughness: (H, W) in [0, 1].
        metallic: (H, W) in [0, 1].
        cut: True for the first frame of a shot, which uses no earlier frame.
        carried: name -> (H, W, C) further planes of a rendered frame, such as ``alpha``: warped and enlarged as its colour is, without
            the network.
    """

    number: int
    color: Array | None
    motion: Array
    normal: Array
    depth: Array
    position: Array
    stencil: Array
    nov: Array
    base_color: Array
    roughness: Array
    metallic: Array
    cut: bool = False
    carried: Mapping[str, Array] = field(default_factory=dict[str, Array])

    def __repr__(self) -> str:
        """One line, without the numbers of the arrays."""
        of = ["" if self.color is None else ", rendered", ", cut" if self.cut else "", *(f", {name}" for name in self.carried)]
        return f"Buffers({self.number}, {self.size}{''.join(of)})"

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return self.depth.shape[0], self.depth.shape[1]
