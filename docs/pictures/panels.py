# SPDX-License-Identifier: MIT
"""``python docs/pictures/panels.py PICTURE FRAME Y,X,H,W FOLDER...``: the same part of a frame of each folder, side by side.

A part of less than 200 pixels is shown twice as large. ``methods.png``: 9 115,100,96,96 of ``stss methods``, and the truth;
``methods-aliased.png``: 9 140,270,96,96. ``first.png``, of the scene in ``street.py`` beside this file, which is ours (MIT), by a
Python with bpy (``make test-blender`` makes one)::

    .venv-blender/bin/python docs/pictures/street.py street
    for weights in bilinear auto; do
        stss run street/lr -o street/$weights --profile blender --camera street/camera.csv --rendered even --weights $weights --overwrite
    done
    python docs/pictures/panels.py docs/pictures/first.png 5 300,1090,530,272 street/bilinear street/auto street/truth
"""

import sys
from pathlib import Path

import numpy as np

from stss.images.color import transfer
from stss.images.read_write import read_rgb, write_rgb

GAP, SMALL = 6, 200

picture, number, place, *folders = sys.argv[1:]
y, x, height, width = map(int, place.split(","))
zoom = 2 if height < SMALL else 1
panels = []
for folder in folders:
    image = read_rgb(next(Path(folder).glob(f"*{int(number):04d}.exr")))[y : y + height, x : x + width]
    pixels = transfer("srgb").display(image).repeat(zoom, axis=0).repeat(zoom, axis=1)
    panels.append(np.pad(pixels, ((0, 0), (0, GAP), (0, 0)), constant_values=1))
write_rgb(Path(picture), np.concatenate(panels, axis=1)[:, :-GAP])
