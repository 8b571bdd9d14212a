# SPDX-License-Identifier: MIT
"""Frames as arrays, without a file: what an engine hands over, frame by frame, and gets back.

Run it::

    python engine_engineer.py

An engine renders every second frame, small. For each display frame, rendered or not, it hands over G-buffer and motion, and gets an
image of twice the size before it goes on to the next one. Here an analytic scene stands in for the engine.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

import stss
from conformance.scenes import DEMO, render

HEIGHT, WIDTH, FRAMES = 48, 80, 6


def engine() -> Iterator[tuple[int, dict[str, NDArray[np.float64]]]]:
    """The engine's side: planes in its own conventions; every second frame is not rendered."""
    for number in range(FRAMES):
        frame = render(DEMO, number, HEIGHT, WIDTH)
        planes = {name: getattr(frame, name) for name in frame.__dataclass_fields__}
        planes["motion"] = frame.motion * (-2 / WIDTH, 2 / HEIGHT)  # NDC, from the previous place to the current one, y up
        planes["position"] = np.where(np.isfinite(frame.depth)[..., None], frame.position / 100, 1e5)  # metres
        if number % 2:
            del planes["color"]
        yield number, planes


def main() -> None:
    """Supersample, and say what came of each frame."""
    rules = stss.load_profile("stss", units_per_cm=0.01, motion={"unit": "ndc", "y": "up", "direction": "from_previous"})
    loop = stss.Supersampler("realtime")
    for number, planes in engine():
        output = loop.push(stss.convert(number, planes, rules))
        assert output is not None  # the first frame was rendered
        height, width, _ = output.image.shape
        print(f"frame {output.number} {output.kind.value}: {width} x {height}, {(~output.valid).sum()} pixels in holes")


if __name__ == "__main__":
    main()
