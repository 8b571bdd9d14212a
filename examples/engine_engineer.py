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

import stss
from conformance.scenes import DEMO, render

HEIGHT, WIDTH, FRAMES = 48, 80, 6


def engine() -> Iterator[stss.Buffers]:
    """The engine's side: arrays in the conventions of docs/stages.md."""
    for number in range(FRAMES):
        frame = render(DEMO, number, HEIGHT, WIDTH)
        # Suppose the engine's motion is in screen widths and heights, from the previous place to the current one, y up.
        motion_uv = frame.motion / (WIDTH, HEIGHT) * (-1, 1)
        yield stss.Buffers(
            number=number,
            color=frame.color.astype(np.float32) if number % 2 == 0 else None,  # every second frame is not rendered
            motion=(motion_uv * (-WIDTH, HEIGHT)).astype(np.float32),  # pixels, current -> previous, x right, y down
            normal=frame.normal.astype(np.float32),
            depth=frame.depth.astype(np.float32),
            position=frame.position.astype(np.float32),  # cm
            stencil=frame.stencil.astype(np.float32),
            nov=frame.nov.astype(np.float32),
            base_color=frame.base_color.astype(np.float32),
            roughness=frame.roughness.astype(np.float32),
            metallic=frame.metallic.astype(np.float32),
        )


def main() -> None:
    """Supersample, and say what came of each frame."""
    backend = stss.open_backend("cl", stss.load_weights("realtime").weights)
    for output in stss.supersample(engine(), backend, transfer_name="srgb"):
        height, width, _ = output.image.shape
        print(f"frame {output.number} {output.kind.value}: {width} x {height}, {(~output.valid).sum()} pixels in holes")


if __name__ == "__main__":
    main()
