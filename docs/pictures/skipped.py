# SPDX-License-Identifier: MIT
"""``python docs/pictures/skipped.py``: three canonical scenes at 480 x 272, each with the share of the network computed in every tile."""

from pathlib import Path

import numpy as np

from conformance.scenes import SCENES
from stss.frames.display_frame import schedule_of, window_at
from stss.images.read_write import write_rgb
from stss.sequence.scenes import display_frames
from stss.weights.file import load
from stss_cl.skip.stream import Stream

PANELS = ("interface", "object", "sky")
COUNT = 13  # the last frame is an SF, computed after several of its kind
BUSY, DIM = (1.0, 0.35, 0.05), 0.5
"""Colour of the computed part; brightness of the rest, which is grey, as a share of the frame's."""


def panel(scene):
    """The last frame of a scene, coloured."""
    stream, frames = Stream(load("antialiased").weights), list(display_frames(SCENES[scene], (136, 240), COUNT))
    for number in range(COUNT):
        window = window_at(frames, number)
        schedule = schedule_of(window)
        assert schedule is not None
        image, _ = stream(window, schedule.steps)
    share = stream.activity().repeat(8, axis=0).repeat(8, axis=1)[: image.shape[0], : image.shape[1], None]
    grey = DIM * np.clip(image, 0, 1).mean(axis=-1, keepdims=True)
    return grey + share * (1 - DIM) * np.asarray(BUSY, np.float32)


if __name__ == "__main__":
    write_rgb(Path(__file__).with_suffix(".png"), np.concatenate([panel(scene) for scene in PANELS], axis=1))
