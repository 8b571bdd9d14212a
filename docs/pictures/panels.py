# SPDX-License-Identifier: MIT
"""``python docs/pictures/panels.py PICTURE FRAME Y,X FOLDER...``: the same part of a frame of each folder, side by side.

``first.png``: 13 24,64 and `bilinear`, `output`, `truth` of ``stss demo``; ``methods*.png``: of ``stss methods``, and the truth.
"""

import sys
from pathlib import Path

import numpy as np

from stss.images.color import transfer
from stss.images.read_write import read_rgb, write_rgb

SIDE, ZOOM, GAP = 96, 2, 6

picture, number, place, *folders = sys.argv[1:]
y, x = map(int, place.split(","))
panels = []
for folder in folders:
    shown = transfer("srgb").display(read_rgb(next(Path(folder).glob(f"*{int(number):04d}.exr"))))[y : y + SIDE, x : x + SIDE]
    panels.append(np.pad(shown.repeat(ZOOM, axis=0).repeat(ZOOM, axis=1), ((0, 0), (0, GAP), (0, 0)), constant_values=1))
write_rgb(Path(picture), np.concatenate(panels, axis=1)[:, :-GAP])
