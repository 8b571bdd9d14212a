# SPDX-License-Identifier: MIT
"""``python docs/pictures/methods.py METHODS TRUTH FRAME Y,X PICTURE``: a part of a frame by ``stss methods``, then its truth."""

import sys
from pathlib import Path

import numpy as np

from stss.images.color import transfer
from stss.images.read_write import read_rgb, write_rgb

SHOWN = ("bilinear", "lanczos", "taau", "network")
SIDE, ZOOM, GAP = 96, 2, 6


def panel(path, y, x):
    """The part of a frame as a screen shows it."""
    shown = transfer("srgb").display(read_rgb(path))[y : y + SIDE, x : x + SIDE].repeat(ZOOM, axis=0).repeat(ZOOM, axis=1)
    return np.pad(shown, ((0, 0), (0, GAP), (0, 0)), constant_values=1)


if __name__ == "__main__":
    methods, truth, number, place, picture = sys.argv[1:]
    paths = [*(Path(methods) / name for name in SHOWN), Path(truth)]
    found = [next(iter(sorted(folder.glob(f"*{int(number):04d}.exr")))) for folder in paths]
    panels = [panel(path, *map(int, place.split(","))) for path in found]
    write_rgb(Path(picture), np.concatenate(panels, axis=1)[:, :-GAP])
