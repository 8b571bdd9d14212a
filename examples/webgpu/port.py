# SPDX-License-Identifier: MIT
"""A port in WGSL, of all stages. The shaders are beside this file; here stands which run, in which order, on which buffers.

With the packages stss and wgpu::

    stss conform --exec "python examples/webgpu/port.py"
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gpu import Calls, Picture
from numpy.typing import NDArray

from conformance.reference_port import answer_job, serve

Arrays = Mapping[str, NDArray[Any]]
COPIED, CORNERS, CENTRES, EIGHTH = range(4)


class Port:
    """The port's members: see docs/ports.md."""

    name, dtype = "webgpu", "float32"

    def stages(self) -> frozenset[str]:
        """All of them."""
        return frozenset(STAGES)

    def run(self, stage: str, inputs: Arrays, weights: Arrays | None = None) -> dict[str, NDArray[Any]]:
        """One stage of docs/stages.md."""
        results = STAGES[stage](make := Maker(weights or {}), inputs)
        arrays = dict(zip(results, make.play(list(results.values())), strict=True))
        return {name: a[..., 0].astype(np.uint8) if name in ("valid", "inside") else a.copy() for name, a in arrays.items()}


class Maker(Calls):
    """The stages as calls; a method's pictures have the names of docs/stages.md."""

    def __init__(self, weights: Arrays):
        super().__init__()
        self.weights = weights

    def copy(
        self, x: Picture, y: Picture, first: int = 0, size: int = COPIED, *, channels: int = 0, positive: bool = False,
        times: Picture | None = None, where: Picture | None = None,
    ) -> Picture:  # fmt: skip
        """``x``, or the first ``channels`` of it, into the channels of ``y`` from ``first`` on; returns ``y``."""
        uniform = (
            x.width,
            x.height,
            x.channels,
            y.width,
            y.height,
            y.channels,
            first,
            size,
            positive,
            1 if times else 2 if where else 0,
        )
        self.add("resample.copy", y, channels or x.channels, uniform, {1: x, 2: times or where or x, 3: y})
        return y

    def concat(self, *xs: Picture) -> Picture:
        """Channels one behind the other."""
        y = self.empty(xs[0].height, xs[0].width, sum(x.channels for x in xs))
        for i, x in enumerate(xs):
            self.copy(x, y, sum(x.channels for x in xs[:i]))
        return y

    def conv(self, x: Picture, name: str, stride: int = 1, *, relu: bool = True) -> Picture:
        """A convolution."""
        weight, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        outputs, _, _, side = weight.shape
        y = self.empty(-(-x.height // stride), -(-x.width // stride), outputs)
        uniform = x.width, x.height, x.channels, outputs, stride, relu, side // 2
        self.add("conv.conv", y, outputs, uniform, {1: x, 2: self.put(weight), 3: self.put(bias[None]), 4: y})
        return y

    def gated(self, x: Picture, name: str, stride: int = 1, *, relu: bool = True) -> Picture:
        """A gated convolution. The ReLU may come before the product: a sigmoid is never negative."""
        y = self.conv(x, f"{name}.conv_feature", stride, relu=relu)
        gate = self.conv(x, f"{name}.conv_mask.0", stride, relu=False)
        self.add("conv.gate", y, 1, (y.width, y.height, 1, y.channels), {4: y, 5: gate})
        return y

    def motion_chain(self, motions: list[Picture]) -> list[Picture]:
        """The chained motion over 1, 2, ... frames."""
        chain = motions[:1]
        for earlier in motions[1:]:
            longer = self.empty(earlier.height, earlier.width, 2)
            self.add("motion_chain.main", longer, 1, (longer.width, longer.height), {1: chain[-1], 2: earlier, 3: longer})
            chain.append(longer)
        return chain

    def warp(self, color: Picture, motion: Picture) -> tuple[Picture, Picture]:
        """``warped`` and ``inside``."""
        warped, inside = self.empty(color.height, color.width, color.channels), self.empty(color.height, color.width)
        uniform = color.width, color.height, color.channels
        self.add("warp.main", color, 1, uniform, {1: color, 2: motion, 3: warped, 4: inside})
        return warped, inside

    def holes(self, motion: Picture, earlier: Picture, now: Picture, view: Picture, *, paper: bool) -> Picture:
        """``valid``; two pictures of `surface`, and NoV with depth; ``paper``: by the paper's test."""
        valid = self.empty(motion.height, motion.width)
        uniform = valid.width, valid.height, 1, paper
        self.add("holes.main", valid, 1, uniform, {1: motion, 2: earlier, 3: now, 4: view, 5: valid})
        return valid

    def occlusion_warp(
        self, color: Picture, warped: Picture, motion: Picture, depth: Picture, valid: Picture
    ) -> tuple[Picture, Picture]:
        """``occlusion_motion`` and ``occlusion_warp``."""
        nearest, winner = self.empty(depth.height, depth.width), self.empty(depth.height, depth.width)
        occlusion_motion, size = self.empty(depth.height, depth.width, 2), (depth.width, depth.height)
        self.add("occlusion_warp.splat_depth", depth, 1, size, {1: motion, 2: depth, 3: nearest, 4: winner})
        self.add("occlusion_warp.splat_index", depth, 1, size, {1: motion, 2: depth, 3: nearest, 4: winner})
        self.add("occlusion_warp.lookup", depth, 1, size, {1: motion, 4: winner, 5: occlusion_motion})
        return occlusion_motion, self.copy(warped, self.warp(color, occlusion_motion)[0], where=valid)

    def reshade(
        self,
        color: Picture,
        warped: Picture,
        motion: Picture,
        valid: Picture,
        surfaces: tuple[Picture, Picture],
        base_color: Picture,
    ) -> Picture:
        """``reshade``; two pictures of `surface`, the earlier one first."""
        samples, lights = (self.empty(valid.height, valid.width, 4) for _ in range(2))
        filled = self.copy(warped, self.empty(valid.height, valid.width, 3), positive=True)
        earlier, now = surfaces
        size = valid.width, valid.height
        self.add("reshade.find_samples", valid, 1, size, {1: motion, 2: earlier, 3: now, 4: color, 5: valid, 7: samples})
        around = {3: now, 5: valid, 6: base_color, 7: samples, 8: filled, 9: lights}
        self.add("reshade.find_lights", valid, 1, size, around)
        self.add("reshade.fill", valid, 1, size, around)
        return filled

    def detail(self, first: Picture, frames: list[tuple[Picture, Picture, Picture]]) -> Picture:
        """The second colour of weights that want it; of each frame that is warped its colour, the motion to it, and object numbers."""
        quarters, second = self.empty(first.height, first.width, 8), self.empty(first.height, first.width, 3)
        size = first.width, first.height
        for color, motion, numbers in frames:
            self.add("detail.add_samples", first, 1, size, {1: color, 2: motion, 3: numbers, 4: quarters})
        self.add("detail.show_detail", first, 1, size, {1: first, 4: quarters, 5: second})
        return second

    def rrm(self, valid: Picture, rectangle: NDArray[Any]) -> Picture:
        """``valid`` with a hole."""
        masked = self.empty(valid.height, valid.width)
        self.add("rrm.main", valid, 1, (valid.width, valid.height, *map(int, rectangle)), {1: valid, 2: masked})
        return masked

    def history(self, frames: list[Picture]) -> Picture:
        """``feature``; three frames, oldest first."""
        features = []
        for frame in frames:
            y = frame
            for name in ("convHis1", "convHis2", "convHis3"):
                y = self.conv(self.conv(self.conv(y, f"{name}.0", 2), f"{name}.2"), f"{name}.4")
            features.append(y)
        return self.gated(self.concat(*features), "lowlevelGated", relu=False)

    def encoder(self, color: Picture, gbuffer: Picture, mask: Picture) -> list[Picture]:
        """``x1`` to ``x4``."""
        x = self.empty(color.height, color.width, 21)
        self.copy(color, x)
        self.copy(color, x, 6, times=mask)
        x = self.gated(self.gated(self.copy(gbuffer, x, 12), "conv1"), "conv2")
        scales = [x]
        for name in ("down1", "down2", "down3"):
            x = self.gated(x, f"{name}.downsample", 2, relu=False)
            x = self.gated(self.gated(x, f"{name}.conv1"), f"{name}.conv2")
            scales.append(x)
        return scales

    def erm(self, x4: Picture, gbuffer: Picture, mask: Picture) -> Picture:
        """``reshaded``."""
        keys, trust = (self.copy(x, self.empty(x4.height, x4.width, x.channels), size=EIGHTH) for x in (gbuffer, mask))
        light = self.concat(x4, keys)
        for layer in (0, 2, 4):
            light = self.conv(light, f"latentEncoder.{layer}", relu=layer < 4)
            keys = self.conv(keys, f"KEncoder.{layer}", relu=layer < 4)
        reshaded = self.empty(x4.height, x4.width, 64)
        self.add("erm.reshade", x4, 1, (x4.width, x4.height), {1: keys, 2: light, 3: trust, 4: reshaded})
        return reshaded

    def decoder(self, u: list[Picture], skips: list[Picture], color: Picture, size: tuple[int, int]) -> Picture:
        """``image``, cropped to ``size``; ``u`` is ``reshaded`` and ``feature``, ``skips`` begin with ``x1``."""
        for name, skip in zip(("up1", "up2", "up3"), skips[2::-1], strict=True):
            larger = [self.copy(x, self.empty(skip.height, skip.width, x.channels), size=CORNERS) for x in u]
            x = self.conv(self.concat(skip, *larger), f"{name}.conv.double_conv.0")
            u = [self.conv(x, f"{name}.conv.double_conv.2")]
        residual = self.conv(u[0], "outc", relu=False)
        image = self.copy(color, self.empty(*size, 3), size=CENTRES, channels=3)
        self.add(
            "resample.shuffle", image, 3, (color.width, color.height, 12, image.width, image.height), {1: residual, 3: image}
        )
        return image

    def network(self, color: Picture, gbuffer: Picture, mask: Picture, history: list[Picture]) -> Picture:
        """``image``."""
        size = 2 * color.height, 2 * color.width
        rows, columns = -(-color.height // 8) * 8, -(-color.width // 8) * 8
        color, gbuffer, mask, *history = (
            self.copy(x, self.empty(rows, columns, x.channels)) for x in (color, gbuffer, mask, *history)
        )
        scales = self.encoder(color, gbuffer, mask)
        return self.decoder([self.erm(scales[3], gbuffer, mask), self.history(history)], scales, color, size)

    def accumulate(self, image: Picture, earlier: list[Picture], motions: list[Picture]) -> Picture:
        """``shown``."""
        total, shown = (self.empty(image.height, image.width, image.channels) for _ in range(2))
        for i, (then, motion) in enumerate(zip(earlier, motions, strict=True)):
            uniform = image.width, image.height, image.channels, i
            self.add("accumulate.main", shown, 1, uniform, {1: image, 2: then, 3: motion, 4: total, 5: shown})
        return shown

    def frame(self, inputs: Arrays) -> Picture:
        """``image``."""
        steps = [int(step) for step in inputs["steps"]]
        colors = [self.put(color) for color in inputs["colors"]]
        gbuffer, depth = self.put(inputs["gbuffer"]), inputs["gbuffer"][..., 3]
        height, width = depth.shape
        chain = self.motion_chain([self.put(motion) for motion in inputs["motions"][: max(steps)]]) if max(steps) else []
        surfaces = [self.put(surface(*of)) for of in zip(inputs["normals"], inputs["stencils"], inputs["positions"], strict=True)]
        view = self.put(np.stack([inputs["nov"], depth], axis=-1))
        paper = getattr(self.weights, "hole_test", "footprint") == "paper"
        warped, valid = list(colors), [self.put(np.ones((height, width))) for _ in steps]
        for i, step in enumerate(steps):
            if step:
                warped[i], _ = self.warp(colors[i], chain[step - 1])
                valid[i] = self.holes(chain[step - 1], surfaces[i + 1], surfaces[0], view, paper=paper)
            if i and step == steps[i - 1]:
                valid[i] = self.empty(height, width)  # a missing frame
        instead = warped[0]
        if steps[0] and getattr(self.weights, "hole_fill", "occlusion_warp") == "reshade":
            base_color = self.put(inputs["gbuffer"][..., 6:9])
            instead = self.reshade(colors[0], warped[0], chain[steps[0] - 1], valid[0], (surfaces[1], surfaces[0]), base_color)
        elif steps[0]:
            _, instead = self.occlusion_warp(colors[0], warped[0], chain[steps[0] - 1], self.put(depth), valid[0])
        color = self.copy(instead, self.empty(height, width, 6), positive=True)
        self.copy(warped[0], color, 3, positive=True)
        if getattr(self.weights, "second_color", "newest") == "detail":
            numbers = [self.put(np.stack([then, inputs["stencils"][0]], axis=-1)) for then in inputs["stencils"][1:]]
            there = [i for i, step in enumerate(steps) if step > (0, *steps)[i]]
            frames = [(colors[i], chain[steps[i] - 1], numbers[i]) for i in there]
            self.copy(self.detail(self.copy(color, self.empty(height, width, 3), channels=3), frames), color, 3)
        history = [self.copy(w, self.empty(height, width, 4), positive=True) for w in warped]
        return self.network(color, gbuffer, valid[0], [self.copy(v, h, 3) for v, h in zip(valid, history, strict=True)][::-1])


def surface(normal: NDArray[Any], stencil: NDArray[Any], position: NDArray[Any]) -> NDArray[Any]:
    """(H, W, 8): the struct of holes.wgsl."""
    return np.concatenate([normal, stencil[..., None], position, np.zeros_like(stencil)[..., None]], axis=-1)


def _holes(make: Maker, inputs: Arrays) -> dict[str, Picture]:
    earlier, now = (surface(inputs[f"normal{of}"], inputs[f"stencil{of}"], inputs[f"position{of}"]) for of in ("_previous", ""))
    view = np.stack([inputs["nov"], inputs["depth"]], axis=-1)
    return {"valid": make.holes(*map(make.put, (inputs["motion"], earlier, now, view)), paper=bool(inputs["paper"][0]))}


def _reshade(make: Maker, inputs: Arrays) -> dict[str, Picture]:
    earlier, now = (surface(inputs[f"normal{of}"], inputs[f"stencil{of}"], inputs[f"position{of}"]) for of in ("_previous", ""))
    color, warped, motion, valid, base_color = (make.put(inputs[n]) for n in ("color", "warped", "motion", "valid", "base_color"))
    return {"reshade": make.reshade(color, warped, motion, valid, (make.put(earlier), make.put(now)), base_color)}


def _by_name(method: str, inputs: str, outputs: str) -> Any:
    """A stage whose method takes its inputs as they come; a stack of pictures is a list."""

    def run(make: Maker, planes: Arrays) -> dict[str, Picture]:
        arrays = [planes[name] for name in inputs.split()]
        pictures = getattr(make, method)(*([make.put(x) for x in a] if a.ndim == 4 else make.put(a) for a in arrays))
        return dict(zip(outputs.split(), pictures if isinstance(pictures, (tuple, list)) else [pictures], strict=True))

    return run


def _decoder(make: Maker, inputs: Arrays) -> dict[str, Picture]:
    put = {name: make.put(array) for name, array in inputs.items()}
    size = 2 * put["color"].height, 2 * put["color"].width
    return {"image": make.decoder([put["reshaded"], put["feature"]], [put["x1"], put["x2"], put["x3"]], put["color"], size)}


STAGES: dict[str, Callable[[Maker, Arrays], dict[str, Picture]]] = {
    "motion_chain": lambda make, arrays: {"motion": make.motion_chain([*map(make.put, arrays["motions"])])[-1]},
    "warp": _by_name("warp", "color motion", "warped inside"),
    "holes": _holes,
    "reshade": _reshade,
    "occlusion_warp": _by_name("occlusion_warp", "color warped motion depth valid", "occlusion_motion occlusion_warp"),
    "rrm": lambda make, arrays: {"valid": make.rrm(make.put(arrays["valid"]), arrays["rectangle"])},
    "history": _by_name("history", "history", "feature"),
    "encoder": _by_name("encoder", "color gbuffer mask", "x1 x2 x3 x4"),
    "erm": _by_name("erm", "x4 gbuffer mask", "reshaded"),
    "decoder": _decoder,
    "network": _by_name("network", "color gbuffer mask history", "image"),
    "frame": lambda make, arrays: {"image": make.frame(arrays)},
    "accumulate": _by_name("accumulate", "image earlier motions", "shown"),
}


if __name__ == "__main__":
    if sys.argv[1] == "--serve":
        serve(Port())
    else:
        answer_job(Path(sys.argv[1]), Port())
