# SPDX-License-Identifier: MIT
"""``python docs/pictures/skipped.py``: four canonical scenes at 480 x 272, each with the share of the network computed in every tile."""

from pathlib import Path

import numpy as np

from conformance.scenes import SCENES
from stss.frames.display_frame import window_at
from stss.frames.supersample import plan
from stss.images.read_write import write_rgb
from stss.run.skip_report import picture
from stss.sequence.scenes import display_frames
from stss.weights.file import load
from stss_cl.skip.stream import Stream

PANELS = (("interface", "exact"), ("object", "exact"), ("sky", "exact"), ("pan", "bounded"))
COUNT = 13  # the last frame is an SF, computed after several of its kind


def panel(scene, skip):
    """The last frame of a scene, coloured."""
    stream, frames = (
        Stream(load("antialiased").weights, skip=skip, max_error=2 / 255),
        list(display_frames(SCENES[scene], (136, 240), COUNT)),
    )
    for number in range(COUNT):
        window = window_at(frames, number)
        image, _ = stream(window, plan(window).steps)
    return picture(image, stream.activity())


if __name__ == "__main__":
    made = [panel(*each) for each in PANELS]
    sheet = np.concatenate([np.concatenate(made[i : i + 2], axis=1) for i in (0, 2)])
    write_rgb(Path(__file__).with_suffix(".png"), sheet)
