# SPDX-License-Identifier: MIT
"""An engine's loop, whole: its planes for each display frame, and its picture.

``python engine_loop.py shown`` writes 59 PNG of 320 x 192: frame 40, which was dropped, has none.

An analytic scene stands in for the renderer, with the buffers of an engine: reversed infinite depth, motion in UV, metres, HDR, a
camera jittered by half pixels. Objects move, a spark is drawn that no G-buffer knows, the camera cuts, and a frame is dropped.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio  # noqa: N813
from numpy.typing import NDArray

import stss
from conformance.scenes import SCENES, look

Array = NDArray[np.float64]
HEIGHT, WIDTH, FRAMES, CUT, DROPPED, NEAR = 96, 160, 60, 8, 40, 0.1
SCENE, EXPOSURE = SCENES["cut"], 1.5
JITTER = ((0.0, 0.0), (0.5, 0.5), (0.5, 0.0), (0.0, 0.5))
RULES = stss.load_profile(
    "stss",
    units_per_cm=0.01,  # metres
    motion={"unit": "uv", "direction": "from_previous"},
    depth={"kind": "device", "near": NEAR, "far": math.inf, "reversed": True},
)


def jitter(number: int) -> Array:
    """By how many low-resolution pixels the picture is shifted, right and down: a step for each rendered frame and the one behind it."""
    return np.array(JITTER[number // 2 % 4])


def draw(number: int, size: tuple[int, int]) -> dict[str, Array]:
    """The renderer: G-buffer and motion of every frame, colour of every second one, and of the first of a shot."""
    (height, width), (y, x) = size, np.indices(size).reshape(2, -1)
    view = look(SCENE, number, x - jitter(number)[0], y - jitter(number)[1], size)
    planes: dict[str, Array] = {
        name: getattr(view, name) for name in ("normal", "stencil", "base_color", "roughness", "metallic")
    }
    to_previous = view.motion + jitter(number - 1) - jitter(number)
    planes |= {"motion": -to_previous / (width, height), "depth": NEAR / (view.depth / 100), "position": view.position / 100}
    if number % 2 == 0:
        spark = (x / width - number / FRAMES) ** 2 + (y / width - 0.15) ** 2 < 0.02**2
        planes["color"] = EXPOSURE * np.where(spark[:, None], (20.0, 8.0, 2.0), view.color)
    return {name: plane.reshape(*size, *plane.shape[1:]) for name, plane in planes.items()}


def settle(image: NDArray[np.float32], shift: Array) -> NDArray[np.float32]:
    """The picture without its jitter: moved back by whole display pixels; its last row and column are repeated."""
    x, y = (2 * shift).astype(int)
    return np.pad(image[y:, x:], ((0, y), (0, x), (0, 0)), mode="edge")


def main(folder: Path, size: tuple[int, int] = (HEIGHT, WIDTH), frames: int = FRAMES, weights: str = "realtime") -> None:
    """Hand over frame after frame; where nothing can be made the last picture stays."""
    folder.mkdir(parents=True, exist_ok=True)
    loop, picture = stss.Supersampler(weights), None
    loop.warm_up(size)
    for number in range(frames):
        if number == DROPPED:  # the engine hung; the next frame was not rendered, so that nothing can be made for it
            continue
        camera = np.array(SCENE.camera.position(number)) / 100
        output = loop.push(stss.convert(number, draw(number, size), RULES, camera=camera, cut=number == CUT))
        picture = picture if output is None else settle(output.image, jitter(number))
        assert picture is not None  # the first frame was rendered
        display = (picture / (1 + picture)) ** (1 / 2.2)  # the engine's tone mapping
        oiio.ImageBuf(np.ascontiguousarray(display)).write(str(folder / f"{number:04d}.png"), "uint8")
        print(f"frame {number}: {'the last one again' if output is None else output.kind.value}")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["shown"]))
