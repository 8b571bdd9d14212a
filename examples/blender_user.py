# SPDX-License-Identifier: MIT
"""Frames that Blender rendered: look at them, supersample them, and save what a video editor takes.

Run it on a folder of multilayer EXR files and a table of the camera (docs/profiles.md says which passes to turn on; the extension in
``blender/`` does all of it from a panel)::

    python blender_user.py lr/ camera.csv out/
"""

from __future__ import annotations

import sys
from pathlib import Path

import stss
from stss.images.color import transfer
from stss.images.read_write import write_rgb


def main(frames: Path, camera: Path, out: Path) -> None:
    """Write ``out/frame.NNNN.png``, twice as large, for every frame of the G-buffer."""
    sequence = stss.open_sequence(frames, "blender", camera=camera)
    print(
        f"{len(sequence.numbers)} display frames, {len(sequence.rendered)} with colour, {sequence.size[1]} x {sequence.size[0]}"
    )
    # Blender spreads its samples over the pixel unless told otherwise: the weights for antialiased frames.
    backend = stss.open_backend("cl", stss.load_weights("antialiased").weights)
    # Where every frame has colour, the odd ones count as not rendered: then there is something to compare with.
    every_second = all(number in sequence.rendered for number in sequence.numbers)
    buffers = (sequence.load(n, color=n in sequence.rendered and not (every_second and n % 2)) for n in sequence.numbers)
    out.mkdir(parents=True, exist_ok=True)
    for output in stss.supersample(buffers, backend):
        # The image is scene-linear, as Blender's was. A PNG holds what a screen shows.
        write_rgb(out / f"frame.{output.number:04d}.png", transfer("srgb").display(output.image))
        print(f"frame {output.number}: {output.kind.value}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
