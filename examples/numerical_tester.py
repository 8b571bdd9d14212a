# SPDX-License-Identifier: MIT
"""How to test numerical code against a reference that computes in any precision: three questions, one stage.

Run it::

    python numerical_tester.py

The reference computes in the dtype it is given, so it is its own oracle: float64 is the truth for float32. And a property that must
hold exactly finds what no tolerance would.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stss_ref.warp import warp

Image = NDArray[np.floating]


def careless(color: Image, motion: Image) -> Image:
    """The same stage as many write it: the place as one sum, and the lerp that loses flat colours."""
    height, width, _ = color.shape
    y, x = np.mgrid[:height, :width].astype(motion.dtype)
    x, y = (x + motion[..., 0]).clip(0, width - 1), (y + motion[..., 1]).clip(0, height - 1)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = (x - x0)[..., None].astype(color.dtype), (y - y0)[..., None].astype(color.dtype)
    top = color[y0, x0] * (1 - fx) + color[y0, x1] * fx
    bottom = color[y1, x0] * (1 - fx) + color[y1, x1] * fx
    return top * (1 - fy) + bottom * fy


def reference(color: Image, motion: Image) -> Image:
    """The stage of the specification."""
    return warp(color, motion)[0]


def main() -> None:
    """Ask each of both: how far off, in units of rounding; does it grow with the frame; does a flat frame stay flat?"""
    unit, rng = 2.0**-24, np.random.default_rng(1)
    for name, stage in (("reference", reference), ("careless", careless)):
        for width in (64, 4096):
            # Integers over a power of two: float32 holds them exactly, so that all of the error is the stage's.
            color = rng.integers(0, 2**12, (4, width, 3)) / 2**12
            motion = rng.integers(-(2**15), 2**15, (4, width, 2)) / 2**14 + 1 / 3
            motion = motion.astype(np.float32).astype(np.float64)
            error = stage(color.astype(np.float32), motion.astype(np.float32)) - stage(color, motion)
            print(f"{name}, width {width}: {np.abs(error).max() / unit:.1f} units of rounding")
        flat = np.full((8, 8, 3), 0.1, np.float32)
        moved = stage(flat, rng.uniform(-2, 2, (8, 8, 2)).astype(np.float32))
        print(f"{name}: a flat frame {'stays flat' if (moved == flat).all() else 'does not stay flat'}")


if __name__ == "__main__":
    main()
