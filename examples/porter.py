# SPDX-License-Identifier: MIT
"""A port of one stage, and the command that judges it.

Run in this folder::

    stss conform --port porter:Port

The judge draws hundreds of cases and compares every number with the float64 reference, within a bound derived for float32.
Change a sign below and run it again: it shows the smallest input that gives you away, and keeps it in a folder with a picture.
A port may have one stage or all of them; a program in another language is judged by ``--exec`` (docs/ports.md).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


class Port:
    """Stage ``warp``: an earlier frame, seen from now. Nothing of stss is imported."""

    name, dtype = "my first port", "float32"

    def stages(self) -> frozenset[str]:
        """The stages of this port; the judge leaves out the rest."""
        return frozenset({"warp"})

    def run(self, stage: str, inputs: dict[str, Floats], weights: object = None) -> dict[str, NDArray[np.generic]]:
        """``warped(p) = bilinear(color, clamp(p + motion(p)))``; a motion that is not finite is off screen and reads ``p``."""
        color, motion = inputs["color"], inputs["motion"]
        height, width, _ = color.shape
        finite = np.isfinite(motion[..., 0]) & np.isfinite(motion[..., 1])
        motion = np.where(finite[..., None], motion, 0)
        # A whole pixel and a fraction. The sum p + motion would lose digits at the far end of a wide frame (decision 13).
        whole = np.floor(motion).clip(-(2**24), 2**24)
        fraction = (motion - whole).clip(0, 1)
        y, x = np.mgrid[:height, :width]
        x, y = x + whole[..., 0].astype(np.int64), y + whole[..., 1].astype(np.int64)
        fx, fy = fraction[..., 0], fraction[..., 1]
        inside = finite & (x >= 0) & (y >= 0)
        inside &= ((x < width - 1) | ((x == width - 1) & (fx == 0))) & ((y < height - 1) | ((y == height - 1) & (fy == 0)))
        x0, x1, y0, y1 = x.clip(0, width - 1), (x + 1).clip(0, width - 1), y.clip(0, height - 1), (y + 1).clip(0, height - 1)
        fx, fy = fx[..., None], fy[..., None]
        # a + (b - a) t, not a (1 - t) + b t: a frame of one colour keeps that colour.
        top = color[y0, x0] + (color[y0, x1] - color[y0, x0]) * fx
        bottom = color[y1, x0] + (color[y1, x1] - color[y1, x0]) * fx
        return {"warped": top + (bottom - top) * fy, "inside": inside.astype(np.uint8)}
