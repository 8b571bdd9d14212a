# SPDX-License-Identifier: MIT
"""``python docs/pictures/skipped.py``: three canonical scenes at 480 x 272, each with the share of the network computed in every tile."""

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

PANELS = ("interface", "object", "sky")
COUNT = 13  # the last frame is an SF, computed after several of its kind


def panel(scene):
    """The last frame of a scene, coloured."""
    stream, frames = Stream(load("antialiased").weights), list(display_frames(SCENES[scene], (136, 240), COUNT))
    for number in range(COUNT):
        window = window_at(frames, number)
        image, _ = stream(window, plan(window).steps)
    return picture(image, stream.activity())


if __name__ == "__main__":
    write_rgb(Path(__file__).with_suffix(".png"), np.concatenate([panel(scene) for scene in PANELS], axis=1))
