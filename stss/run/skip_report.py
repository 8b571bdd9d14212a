# SPDX-License-Identifier: MIT
"""What a run did not compute: a line about all of it, and a picture of each frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stss.frames.backends import Cost
from stss_ref.arrays import Array, Image

BUSY = (1.0, 0.35, 0.05)
"""RGB of what was computed, in `picture`."""
DIM = 0.5
"""Brightness of the rest, which is grey, as a share of the frame's."""


def describe_costs(costs: Sequence[Cost]) -> str:
    """One line that says how much of the network a run computed; ``costs`` are those of its frames."""
    whole, part, none = ([cost for cost in costs if cost.network == network] for network in ("whole", "changed", "none"))
    parts = [f"{len(whole)} whole"] if whole else []
    if part:
        parts.append(f"{len(part)} in part ({np.mean([cost.changed for cost in part]):.0%} of the inputs had changed)")
    parts += [f"{len(none)} not at all"] if none else []
    return f"network computed: {', '.join(parts)}"


def picture(image: Image, activity: Array) -> Image:
    """The frame in grey, and in colour how much of the network was computed there.

    Args:
        image: (2H, 2W, 3) display-referred, the output.
        activity: see ``stss_cl.skip.stream.Stream.activity``: (ceil(H / 4), ceil(W / 4)), 0 to 1.

    Returns:
        (2H, 2W, 3) display-referred.
    """
    height, width, _ = image.shape
    share = activity.repeat(8, axis=0).repeat(8, axis=1)[:height, :width, None]
    grey = DIM * np.clip(image, 0, 1).mean(axis=-1, keepdims=True)
    return grey + share * (1 - DIM) * np.asarray(BUSY, np.float32)
