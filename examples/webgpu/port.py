# SPDX-License-Identifier: MIT
"""A port in WGSL: stages ``warp``, ``holes`` and ``history``. The shaders are beside this file; here is only what calls them.

Run in this folder, with the packages stss and wgpu::

    stss conform --port port:Port --require warp,holes,history
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gpu import Pass, empty, pipeline, tiles, uniform, uploaded
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]
CONV = ("conv.wgsl",)


class Port:
    """What the judge asks: see docs/ports.md."""

    name, dtype = "webgpu", "float32"

    def stages(self) -> frozenset[str]:
        """What this port has; the judge leaves out the rest."""
        return frozenset({"warp", "holes", "history"})

    def run(self, stage: str, inputs: Arrays, weights: Arrays | None = None) -> dict[str, NDArray[Any]]:
        """One stage of docs/stages.md."""
        if stage == "history":
            assert weights is not None
            return {"feature": history(inputs["history"], weights)}
        return {"warp": warp, "holes": holes}[stage](inputs)


def warp(given: Arrays) -> dict[str, NDArray[Any]]:
    """Stage ``warp``."""
    height, width, channels = given["color"].shape
    warped, inside = empty(height * width * channels), empty(height * width)
    work = Pass()
    work.dispatch(
        pipeline(("follow.wgsl", "warp.wgsl"), "main"),
        tiles(width, height),
        {0: uniform(width, height, channels), 1: uploaded(given["color"]), 2: uploaded(given["motion"]), 3: warped, 4: inside},
    )
    return {
        "warped": work.read(warped, "f4", (height, width, channels)),
        "inside": work.read(inside, "u4", (height, width)).astype(np.uint8),
    }


def holes(given: Arrays) -> dict[str, NDArray[Any]]:
    """Stage ``holes``."""
    height, width = given["nov"].shape
    valid = empty(height * width)
    work = Pass()
    work.dispatch(
        pipeline(("follow.wgsl", "holes.wgsl"), "main"),
        tiles(width, height),
        {
            0: uniform(width, height, 1),
            1: uploaded(given["motion"]),
            2: uploaded(_surface(given["normal_previous"], given["stencil_previous"], given["position_previous"])),
            3: uploaded(_surface(given["normal"], given["stencil"], given["position"])),
            4: uploaded(np.stack([given["nov"], given["depth"]], axis=-1)),
            5: valid,
        },
    )
    return {"valid": work.read(valid, "u4", (height, width)).astype(np.uint8)}


def _surface(normal: NDArray[Any], stencil: NDArray[Any], position: NDArray[Any]) -> NDArray[Any]:
    """(H, W, 8): the struct of holes.wgsl."""
    return np.concatenate([normal, stencil[..., None], position, np.zeros_like(stencil)[..., None]], axis=-1)


def history(frames: NDArray[Any], weights: Arrays) -> NDArray[Any]:
    """Stage ``history``: nine convolutions of each of three frames, oldest first, then a gated one of all."""
    _, height, width, _ = frames.shape
    rows, columns = height // 8, width // 8
    work, together = Pass(), empty(rows * columns * 96)
    for i, frame in enumerate(frames):
        x, size = uploaded(frame), (height, width)
        for name in ("convHis1", "convHis2", "convHis3"):
            for layer, stride in ((0, 2), (2, 1), (4, 1)):
                last = name == "convHis3" and layer == 4
                x, size = _conv(work, x, size, weights, f"{name}.{layer}", stride, out=(together, 96, 32 * i) if last else None)
    eighth = (rows, columns)
    feature, _ = _conv(work, together, eighth, weights, "lowlevelGated.conv_feature", relu=False)
    mask, _ = _conv(work, together, eighth, weights, "lowlevelGated.conv_mask.0", relu=False)
    layer = uniform(columns, rows, 96, 32, 1, 32, 0, 0)
    work.dispatch(pipeline(CONV, "gate"), (-(-rows * columns // 64), 1, 1), {0: layer, 4: feature, 5: mask})
    return work.read(feature, "f4", (rows, columns, 32))


def _conv(
    work: Pass,
    x: Any,
    size: tuple[int, int],
    weights: Arrays,
    name: str,
    stride: int = 1,
    *,
    relu: bool = True,
    out: tuple[Any, int, int] | None = None,
) -> tuple[Any, tuple[int, int]]:
    """A convolution into a new buffer, or into ``out``: a buffer, its channels, the first of ours; and the size of the result."""
    weight, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
    outputs, inputs = weight.shape[:2]
    height, width = (-(-side // stride) for side in size)
    y, pitch, first = out or (empty(height * width * outputs), outputs, 0)
    layer = uniform(size[1], size[0], inputs, outputs, stride, pitch, first, int(relu))
    buffers = {0: layer, 1: x, 2: uploaded(weight), 3: uploaded(bias), 4: y}
    work.dispatch(pipeline(CONV, "conv"), tiles(width, height, outputs), buffers)
    return y, (height, width)
