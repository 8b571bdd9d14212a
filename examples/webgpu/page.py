# SPDX-License-Identifier: MIT
"""A page that supersamples a sequence in the browser, by the shaders beside this file. It needs no network and no server.

make demo
python examples/webgpu/page.py demo/frames page.html
"""

from __future__ import annotations

import argparse
import base64
import gzip
import os
from pathlib import Path
from typing import Any

import numpy as np
from gpu import Picture, code
from numpy.typing import NDArray
from port import Maker

from stss.frames.display_frame import DisplayFrame, frame_inputs, make_display_frame, schedule_of, window_at
from stss.frames.output import choose_rendered
from stss.images.color import transfer
from stss.sequence.choose_weights import choose_weights
from stss.sequence.reader import open_sequence
from stss_ground.errors import UserError
from stss_ground.output.write_whole import write_named
from stss_ground.pages.page import page
from stss_ref.weights import Weights

FOLDER = Path(__file__).parent
BODY = (FOLDER / "page.html").read_text(encoding="utf-8")


class Store:
    """Arrays, each kept once however many frames use it."""

    def __init__(self) -> None:
        self.arrays: list[NDArray[Any]] = []
        self._places: dict[bytes, int] = {}

    def place(self, array: NDArray[Any]) -> int:
        """Its number."""
        key = array.tobytes()
        if key not in self._places:
            self._places[key] = len(self.arrays)
            self.arrays.append(array)
        return self._places[key]

    def packed(self) -> str:
        """All of them, one behind the other, as gzip in base64."""
        return base64.b64encode(gzip.compress(b"".join(array.tobytes() for array in self.arrays), 6)).decode()


def record_frame(window: list[DisplayFrame], weights: Weights, store: Store) -> dict[str, Any] | None:
    """The calls of the newest frame of ``window``; None where it cannot be made."""
    schedule = schedule_of(window)
    if schedule is None:
        return None
    maker = Maker(weights)
    image: Picture = maker.frame(vars(frame_inputs(window, schedule.steps)))
    color = window[-1 - schedule.steps[0]].color
    assert color is not None
    return {
        "name": f"frame {window[-1].number}, {'rendered' if schedule.steps[0] == 0 else 'not rendered'}",
        "buffers": [b if isinstance(b, int) else [store.place(b)] for b in maker.buffers],
        "calls": maker.calls,
        "image": [image.buffer, image.height, image.width],
        "color": [store.place(np.ascontiguousarray(color, np.float32)), *color.shape[:2]],
    }


def main() -> None:
    """Read a sequence, write the calls down, and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("page", type=Path)
    parser.add_argument("--weights", default="auto", help="as for stss run")
    parser.add_argument("--frames", type=int, default=8, help="most frames of the page")
    options = parser.parse_args()
    try:
        sequence = open_sequence(options.sequence)
        weights = choose_weights(options.weights, sequence, print).weights
        rendered = choose_rendered(sequence.numbers, sequence.rendered, None)
        numbers = sequence.numbers[: options.frames]
        frames = [make_display_frame(sequence.load(n, color=n in rendered), transfer("srgb"), "scale") for n in numbers]
        store = Store()
        frame_calls = [record_frame(list(window_at(frames, i)), weights, store) for i in range(len(frames))]
        data = {
            "frames": [frame for frame in frame_calls if frame is not None],
            "sizes": [array.size for array in store.arrays],
            "packed": store.packed(),
            "shaders": {
                path.stem: code(path.stem) for path in sorted(FOLDER.glob("*.wgsl")) if path.stem not in ("follow", "surface")
            },
        }
        script = (FOLDER / "page.js").read_text(encoding="utf-8")
        write_named(options.page, page(f"{options.sequence.name}, in the browser", BODY, scripts=[script], data=data))
    except UserError as error:
        parser.exit(2, f"{error}{os.linesep}")


if __name__ == "__main__":
    main()
