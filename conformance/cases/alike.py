# SPDX-License-Identifier: MIT
"""Calls with small differences in their inputs: a port that keeps results by a part of its inputs returns those of another call.

Of one array one pixel differs, in the middle, so that first and last rows and borders are the same; or two pixels are exchanged, so that
the sum is the same. Of an array of several frames, each frame's pixel differs in its turn. Of all arrays the upper half and the lower one
are exchanged. Of the weights one number differs, or two are exchanged, or entries of the metadata.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from conformance.cases.large_inputs import network_case
from conformance.cases.stage_inputs import Inputs, make_weights
from conformance.protocol.array_specs import Dim
from conformance.protocol.stages import STAGES
from stss_ref.weights import LAYERS, Weights

Call = tuple[str, Inputs, Weights | None]
"""Words on the difference, and a stage's inputs and weights."""
Place = tuple[int, int]
SIDE = 16
STATIC: Place = (11, 11)
"""Of a static surface; at 1/8 size it is read, too."""
MOVING: Place = (12, 12)
OTHER: Place = (3, 4)
"""Exchanged with `STATIC`; at 1/8 size it is another pixel."""
HEAD_ON: Place = (3, 11)
"""Of a static surface seen head-on, where the paper's hole test allows less."""
DEEP: Place = (9, 11)
"""Of a static surface far away, where that test allows more."""
BELOW: Place = (13, 12)
"""Another pixel of the moving surface."""
AT: dict[str, tuple[Place, Place]] = {
    "normal": (MOVING, BELOW), "warped": (BELOW, (14, 12)), "stencil": (STATIC, MOVING), "valid": (STATIC, BELOW),
    "nov": (STATIC, HEAD_ON), "depth": (HEAD_ON, DEEP),
}  # fmt: skip
"""By the beginning of an array's name: the pixel that differs, and the one that it is exchanged with."""
CHANGES: dict[str, Callable[[NDArray[Any]], Any]] = {
    "motion": lambda v: v * 0 + (3, -8), "stencil": lambda v: 2 - v, "normal": np.negative, "position": lambda v: v * np.nan,
    "nov": lambda v: 1 - v, "mask": lambda v: 1 - v, "valid": lambda v: 1 - v, "depth": lambda v: v * 0 + 1,
}  # fmt: skip
"""By the beginning of an array's name: the pixel's new value; else 3/2 less its old one."""
FLAGS: dict[str, Callable[[NDArray[Any]], Any]] = {
    "paper": lambda v: 1 - v, "rectangle": lambda v: v + np.array([0, 0, 1, 0]), "steps": lambda v: v[[0, 1, 1]],
}  # fmt: skip
"""Inputs that are no images, as a whole."""


def alike_calls(stage: str) -> Callable[[Generator], list[Call]]:
    """Makes the calls of a stage: the first, and those that differ from it."""
    return partial(_calls, stage)


def _calls(stage: str, rng: Generator) -> list[Call]:
    inputs, weights = _BASES[stage](rng) if stage in _BASES else network_case(stage, (SIDE, SIDE), rng)
    inputs = {name: np.array(array) for name, array in inputs.items()}
    if "mask" in inputs:
        inputs["mask"][STATIC], inputs["mask"][OTHER] = 1, 0
    calls: list[Call] = [("the first", inputs, weights)]
    for name, array in inputs.items():
        calls += [(f"{name}: {what}", {**inputs, name: other}, weights) for what, other in _others(stage, name, array)]
    calls.append(("the upper and the lower half of every image exchanged", exchange_halves(stage, inputs), weights))
    if weights is not None:
        calls += [(f"weights: {what}", inputs, other) for what, other in _other_weights(stage, weights)]
    return calls


def _others(stage: str, name: str, array: NDArray[Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Arrays that differ from this one in a small part, and words on the difference."""
    if name in FLAGS:
        yield "another", np.asarray(FLAGS[name](array), array.dtype)
        return
    rows, dim = _rows(stage, name)
    own, other = (tuple(at * dim.times // dim.over for at in place) for place in _by_name(AT, name, (STATIC, OTHER)))
    change = _by_name(CHANGES, name, _less)
    for frame in np.ndindex(array.shape[:rows]):
        one = array.copy()
        one[(*frame, *own)] = change(array[(*frame, *own)])
        yield f"one pixel{f' of frame {frame[0]}' if frame else ''}", one
    first, second = ((*[slice(None)] * rows, *place) for place in (own, other))
    swapped = array.copy()
    swapped[first], swapped[second] = array[second], array[first]
    yield "two pixels exchanged", swapped


def _less(value: NDArray[Any]) -> NDArray[Any]:
    return 1.5 - value


def exchange_halves(stage: str, inputs: Inputs) -> Inputs:
    """The upper half of every image below the lower one."""
    images = {name: array for name, array in inputs.items() if name not in FLAGS}
    axes = {name: _rows(stage, name)[0] for name in images}
    return {**inputs, **{name: np.roll(array, array.shape[axes[name]] // 2, axes[name]) for name, array in images.items()}}


def _rows(stage: str, name: str) -> tuple[int, Dim]:
    """The axis of an array's rows, and how many there are of them."""
    dims = STAGES[stage].inputs[name].dims
    axis = next(axis for axis, dim in enumerate(dims) if dim.letter == "H")
    return axis, dims[axis]


def _by_name(table: dict[str, Any], name: str, default: Any) -> Any:
    return next((value for beginning, value in table.items() if name.startswith(beginning)), default)


def _other_weights(stage: str, weights: Weights) -> Iterator[tuple[str, Weights]]:
    layers = [layer for layer in LAYERS if stage in ("network", "frame") or layer.stage == stage]
    for layer in (layers[0], layers[-1]):
        name = f"{layer.name}{'.conv_feature' if layer.gated else ''}"
        bias = weights[f"{name}.bias"].copy()
        bias[-1] += 1
        yield f"the last number of {name}.bias", weights | {f"{name}.bias": bias}
        kernel = weights[f"{name}.weight"].copy()
        kernel[0], kernel[-1] = kernel[-1].copy(), kernel[0].copy()
        yield f"the first and the last output of {name}.weight exchanged", weights | {f"{name}.weight": kernel}
    if stage == "frame":
        yield "the second colour", replace(weights, second_color="detail")
        yield "the hole test", replace(weights, hole_test="footprint")
        yield "what fills holes", replace(weights, hole_fill="reshade")


def _shift_right(count: int) -> NDArray[np.float64]:
    """(count, H, W, 2) motion to the right, by whole pixels, so that another pixel reads every pixel in the frame's middle."""
    motion = np.zeros((count, SIDE, SIDE, 2))
    motion[..., 0] = 1 + (np.arange(SIDE) < 5)[:, None]
    motion[(slice(None), *OTHER)] = 2, 3
    return motion


def _surfaces(rng: Generator) -> Inputs:
    """(H, W) stencil, nov; (H, W, 3) normal, position: static above, there head-on, and moving below; all along a row alike."""
    rows = np.ones((SIDE, SIDE))
    turned = rng.normal(0, 1, (SIDE, 1, 3))
    turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
    position = np.zeros((SIDE, SIDE, 3))
    position[..., 1] = 20 * np.arange(SIDE)[:, None]
    position[OTHER] = np.nan
    return {
        "stencil": rows * (2.0 * (np.arange(SIDE) >= MOVING[0]))[:, None], "nov": rows * (np.arange(SIDE) < 4)[:, None],
        "normal": np.broadcast_to(turned, (SIDE, SIDE, 3)), "position": position,
    }  # fmt: skip


def _motion_chain(_: Generator) -> tuple[Inputs, None]:
    return {"motions": _shift_right(3)}, None


def _warp(rng: Generator) -> tuple[Inputs, None]:
    return {"color": rng.random((SIDE, SIDE, 3)), "motion": _shift_right(1)[0]}, None


def _holes(rng: Generator) -> tuple[Inputs, None]:
    now = _surfaces(rng)
    before = {f"{name}_previous": now[name] for name in ("stencil", "normal", "position")}
    planes = {"depth": np.full((SIDE, SIDE), 0.1), "paper": np.ones(1, np.int32), "motion": _shift_right(1)[0]}
    planes["depth"][DEEP] = 0.9
    return {**now, **before, **planes}, None


def _occlusion_warp(rng: Generator) -> tuple[Inputs, None]:
    color, warped = rng.random((2, SIDE, SIDE, 3))
    motion = _shift_right(1)[0]
    motion[HEAD_ON] = 1, 1
    depth = rng.uniform(0.2, 0.8, (SIDE, SIDE))
    depth[HEAD_ON] = 0.1
    valid = np.zeros((SIDE, SIDE), np.uint8)
    valid[MOVING[0] :] = 1
    return {"color": color, "warped": warped, "motion": motion, "depth": depth, "valid": valid}, None


def _reshade(rng: Generator) -> tuple[Inputs, None]:
    """Holes in the middle rows, of both surfaces; one of them has no sample of its own."""
    color, warped, base = rng.random((3, SIDE, SIDE, 3))
    now = {name: array for name, array in _surfaces(rng).items() if name != "nov"}
    before = {f"{name}_previous": array for name, array in now.items()}
    motion = _shift_right(1)[0]
    motion[DEEP] = -100, 0
    valid = np.ones((SIDE, SIDE), np.uint8)
    valid[7 : BELOW[0]] = 0
    return {"color": color, "warped": warped, "motion": motion, "valid": valid, **before, **now, "base_color": base}, None


def _rrm(rng: Generator) -> tuple[Inputs, None]:
    valid = (rng.random((SIDE, SIDE)) < 0.5).astype(np.uint8)
    valid[STATIC], valid[BELOW] = 0, 1
    return {"valid": valid, "rectangle": np.array([5, 5, 3, 3], np.int32)}, None


def _accumulate(rng: Generator) -> tuple[Inputs, None]:
    """Most of the earlier images lies within the box, so that any of it shows."""
    image, *earlier = rng.random((3, 2 * SIDE, 2 * SIDE, 3))
    return {"image": image, "earlier": 0.4 + 0.2 * np.stack(earlier), "motions": _shift_right(2)}, None


def _frame(rng: Generator) -> tuple[Inputs, Weights]:
    now = _surfaces(rng)
    gbuffer = rng.random((SIDE, SIDE, 9))
    gbuffer[..., 3] = 0.1
    inputs: Inputs = {
        "colors": rng.random((3, SIDE, SIDE, 3)), "steps": np.array([1, 2, 3], np.int32), "motions": _shift_right(3),
        "gbuffer": gbuffer, "nov": now["nov"],
        **{f"{name}s": np.repeat(now[name][None], 4, axis=0) for name in ("stencil", "normal", "position")},
    }  # fmt: skip
    return inputs, make_weights("random", 0, "newest", "paper")


_BASES: dict[str, Callable[[Generator], tuple[Inputs, Any]]] = {
    "motion_chain": _motion_chain, "warp": _warp, "holes": _holes, "occlusion_warp": _occlusion_warp, "reshade": _reshade,
    "rrm": _rrm, "frame": _frame, "accumulate": _accumulate,
}  # fmt: skip
