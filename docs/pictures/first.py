# SPDX-License-Identifier: MIT
"""``python docs/pictures/first.py DEMO``: a part of an extrapolated frame of ``stss demo DEMO``: bilinear, stss, full render."""

import sys
from pathlib import Path

import numpy as np

from stss.images.color import transfer
from stss.images.read_write import read_rgb, write_rgb

FRAME = 13
PART = (24, 64, 96, 96)  # y, x, height, width: bricks, a target and a box
ZOOM = 3
GAP = 8  # white columns between two panels


def panel(path):
    """The part of a frame as a screen shows it."""
    y, x, height, width = PART
    shown = transfer("srgb").display(read_rgb(path))[y : y + height, x : x + width]
    return shown.repeat(ZOOM, axis=0).repeat(ZOOM, axis=1)


if __name__ == "__main__":
    demo = Path(sys.argv[1])
    paths = (f"bilinear/frame.{FRAME:04d}.exr", f"output/frame.{FRAME:04d}.exr", f"truth/demo.{FRAME:04d}.exr")
    panels = [np.pad(panel(demo / path), ((0, 0), (0, GAP), (0, 0)), constant_values=1) for path in paths]
    write_rgb(Path(__file__).with_suffix(".png"), np.concatenate(panels, axis=1)[:, :-GAP])
