# SPDX-License-Identifier: MIT
"""Hypothesis strategies for whole stages: all inputs of a stage, of one size, steered to where ports go wrong."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from conformance.cases.planes import SEEDS, Size, colors, dyadic_motions, masks, motions, sizes
from conformance.scenes import SCENES, Rendered, render
from stss_ref.constants import EARLIER_SHARES, HOLE_FILLS, HOLE_TESTS, HoleFill, HoleLimits, HoleTest
from stss_ref.holes import squared_footprint
from stss_ref.reshade import COSINE, FOOTPRINTS, STATIC_COSINE
from stss_ref.weights import SECOND_COLORS, TENSORS, SecondColor, Tensors, Weights, check, random

Plane = NDArray[Any]
Inputs = dict[str, Plane]
PAPER = st.sampled_from([0, 0, 0, 1, -1, 2, 255]).map(lambda paper: np.array([paper], np.int32))
"""Stage holes' input that asks for the paper's test: any number but 0 does."""
CHANNELS = 1, 2, 3, 4, 5, 8, 17, 33
"""Channels of the warped array: beyond a texture's four, and beyond the sizes that a port may have reserved."""
STEPS = 1, 2, 3, 4, 5, 9, 17
"""Motions of a chain: the pipeline has up to five, the stage any number."""
WEIGHT_KINDS = ("random", "sparse", "large", "small keys", "faint keys")


def multiples(largest: int = 24) -> st.SearchStrategy[Size]:
    """(H, W) of multiples of 8."""
    steps = st.integers(1, largest // 8).map(lambda n: 8 * n)
    return st.tuples(steps, steps)


@st.composite
def chain_inputs(draw: st.DrawFn, largest: int = 16) -> Inputs:
    """Stage motion_chain: motions of the same or of different kinds."""
    size = draw(sizes(largest))
    count = draw(st.sampled_from(STEPS))
    if draw(st.booleans()):
        # Short steps, none of them 0, stay in the frame, so that the chain runs to its end.
        rng = np.random.default_rng(draw(SEEDS))
        kinds = [draw(st.sampled_from(["whole", "half", "nearly", "any"])) for _ in range(count)]
        return {"motions": np.stack([_short_steps(rng, size, kind) for kind in kinds])}
    return {"motions": np.stack([draw(motions(size, broken=True)) for _ in range(count)])}


def _short_steps(rng: np.random.Generator, size: Size, kind: str) -> NDArray[np.float64]:
    steps: NDArray[np.float64] = rng.choice(np.array([-2.0, -1.0, 1.0, 2.0]), (*size, 2))
    if kind == "half":
        return steps / 2
    if kind == "nearly":
        return steps + np.sign(steps) * 2.0 ** rng.integers(-14, -8, steps.shape) * rng.choice(np.array([-1.0, 1.0]), steps.shape)
    return steps * rng.random(steps.shape) if kind == "any" else steps


@st.composite
def warp_inputs(draw: st.DrawFn, largest: int = 16, color: str = "any", motion: str = "any") -> Inputs:
    """Stage warp."""
    size = draw(sizes(largest))
    moved = draw(motions(size, broken=True) if motion == "any" else dyadic_motions(size, motion))
    return {"color": draw(colors(size, draw(st.sampled_from(CHANNELS)), color)), "motion": moved}


@st.composite
def wide_warp_inputs(draw: st.DrawFn) -> Inputs:
    """Stage warp in frames so wide, or so high, that the sum of a pixel's place and a motion loses most of the fraction by rounding."""
    shape = draw(st.integers(1, 2)), draw(st.integers(1000, 2048))
    size = shape if draw(st.booleans()) else shape[::-1]
    rng = np.random.default_rng(draw(SEEDS))
    return {"color": rng.random((*size, draw(st.integers(1, 3)))), "motion": rng.uniform(-3, 3, (*size, 2))}


@st.composite
def holes_inputs(draw: st.DrawFn, largest: int = 16) -> Inputs:
    """Stage holes: objects and ground, normals of any length, and positions near, far and just at the thresholds."""
    size = draw(sizes(largest))
    rng = np.random.default_rng(draw(SEEDS))
    stencil = _stencil(rng, size, draw(st.sampled_from(["ground", "one", "many"])))
    same_objects = draw(st.booleans())
    normal, position = _normals(draw, rng, size), rng.normal(0, draw(st.sampled_from([1.0, 15.0, 60.0, 1e4])), (*size, 3))
    apart = draw(st.sampled_from([0.0, 1.0, 10.0, 60.0]))
    position_previous = position + rng.normal(0, apart, (*size, 3)) if apart else position.copy()
    if draw(st.integers(0, 9)) == 0:
        position_previous[rng.random(size) < 0.1] = draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    nearly = normal + rng.normal(0, 0.15, normal.shape) * np.linalg.norm(normal, axis=-1, keepdims=True)
    return {
        "motion": draw(motions(size, broken=True)),
        "stencil_previous": stencil if same_objects else _stencil(rng, size, "many"),
        "stencil": stencil,
        "normal_previous": draw(st.sampled_from([normal, nearly, _normals(draw, rng, size)])),
        "normal": normal,
        "position_previous": position_previous,
        "position": position,
        "nov": rng.uniform(-1, 1, size),
        "depth": rng.random(size) if draw(st.booleans()) else np.full(size, rng.random()),
        "paper": draw(PAPER),
    }


@st.composite
def thresholds(draw: st.DrawFn, largest: int = 16) -> Inputs:
    """Stage holes where one comparison decides, near its threshold: distance, angle, or another object."""
    size = draw(sizes(largest))
    rng = np.random.default_rng(draw(SEEDS))
    what = draw(st.sampled_from(["far", "far", "turned", "turned", "leaning", "leaning", "other"]))
    paper = draw(PAPER)
    normal = _unit(rng, size)
    position = rng.normal(0, draw(st.sampled_from([5.0, 500.0])), (*size, 3))
    nov, depth = rng.uniform(-1, 1, size), rng.random(size)
    objects = _stencil(rng, size, "one") / 2 if what == "other" else np.full(size, float(what == "turned"))
    inputs = {"normal": normal, "normal_previous": normal, "position": position, "position_previous": position}
    if what == "far":
        limits = HoleLimits()
        limit = limits.facing * np.abs(nov) + limits.grazing * (1 - np.abs(nov)) + limits.depth * depth
        if not paper[0]:
            limit = limits.footprints * np.sqrt(squared_footprint(position))
        inputs["position_previous"] = position + _unit(rng, size) * (limit * rng.uniform(0.8, 1.2, size))[..., None]
    if what in ("turned", "leaning"):
        # Angles near that of cosine 0.98, or 0.5, or any angle. Lengths differ from 1, since a stage divides by only one of the two.
        near = {"turned": (0.1, 0.4), "leaning": (0.9, 1.2)}[what]
        aside = np.cross(normal, _unit(rng, size))
        aside /= np.maximum(np.linalg.norm(aside, axis=-1, keepdims=True), 1e-6)
        angle = np.where(rng.random(size) < 0.2, rng.uniform(0, np.pi, size), rng.uniform(*near, size))[..., None]
        lengths = [(1.0, 1.0), (1.0, 0.5), (0.99, 1.0), (1.5, 1.0), (1.0, 1e-4), (1.0, 0.0), (0.0, 1.0), (0.0, 0.0)]
        now, before = draw(st.sampled_from(lengths))
        inputs["normal_previous"] = (normal * np.cos(angle) + aside * np.sin(angle)) * before
        inputs["normal"] = normal * now
    moved = draw(st.one_of(dyadic_motions(size, "still"), dyadic_motions(size, "short"), motions(size)))
    same = draw(st.booleans()) or what != "other"
    other = objects if same else np.zeros(size)
    return {**inputs, "motion": moved, "stencil_previous": objects, "stencil": other, "nov": nov, "depth": depth, "paper": paper}


def _unit(rng: np.random.Generator, size: Size) -> NDArray[np.float64]:
    vector = rng.normal(0, 1, (*size, 3))
    return np.asarray(vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-6), np.float64)


@st.composite
def occlusion_inputs(draw: st.DrawFn, largest: int = 16, motion: str = "any") -> Inputs:
    """Stage occlusion_warp, also with depths that tie, that are all the same, or that never splat."""
    size = draw(sizes(largest))
    rng = np.random.default_rng(draw(SEEDS))
    moved = draw(motions(size, broken=True) if motion == "any" else dyadic_motions(size, motion))
    color = draw(colors(size, 3))
    return {
        "color": color,
        "warped": draw(colors(size, 3)),
        "motion": moved,
        "depth": depths(rng, size, draw(st.sampled_from(["any", "ties", "close", "flat", "far"]))),
        "valid": draw(masks(size)).astype(np.uint8),
    }


@st.composite
def reshade_inputs(draw: st.DrawFn, largest: int = 20, color: str = "any") -> Inputs:
    """Stage reshade: holes alone, in clumps and everywhere; samples near the limits of a surface; few materials, mixed ones, or any."""
    size = draw(sizes(largest))
    rng = np.random.default_rng(draw(SEEDS))
    stencil = _stencil(rng, size, draw(st.sampled_from(["ground", "one", "many"])))
    normal = _normals(draw, rng, size)
    y, x = np.indices(size)
    position = np.stack([x, y, 0 * x], -1) * draw(st.sampled_from([0.0, 0.5, 8.0, 500.0])) + rng.integers(-1, 2, (*size, 3))
    limit = FOOTPRINTS * np.sqrt(squared_footprint(position))
    apart = limit * rng.uniform(0.5, 1.5, size) * (rng.random(size) < draw(st.sampled_from([0.0, 0.5, 1.0])))
    position_previous = position + _unit(rng, size) * apart[..., None]
    if draw(st.integers(0, 9)) == 0:
        position_previous[rng.random(size) < 0.2] = draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    aside = np.cross(normal, _unit(rng, size))
    cosine = np.where(stencil == 0, STATIC_COSINE, COSINE)[..., None]
    turned = normal * cosine + aside * (np.sqrt(1 - cosine**2) * rng.uniform(0.5, 1.5, (*size, 1)))
    if draw(st.integers(0, 3)) == 0:
        normal = normal * rng.choice([1.0, 0.75, 0.4, 0.125], (*size, 1))  # means with a background
    base_color = rng.random((*size, 3))
    if draw(st.booleans()):
        base_color = rng.choice(np.array(draw(st.sampled_from([(0.0, 0.25, 1.0), (-0.25, 0.0, 0.5, 2.0)]))), (*size, 3))
    return {
        "color": draw(colors(size, 3, color)),
        "warped": draw(colors(size, 3, color)),
        "motion": draw(st.one_of(dyadic_motions(size, "short"), motions(size, broken=True))),
        "valid": draw(masks(size)).astype(np.uint8),
        "stencil_previous": stencil if draw(st.booleans()) else _stencil(rng, size, "many"),
        "stencil": stencil,
        "normal_previous": draw(st.sampled_from([normal, turned, _normals(draw, rng, size)])),
        "normal": normal,
        "position_previous": position_previous,
        "position": position,
        "base_color": base_color,
    }


def depths(rng: np.random.Generator, size: Size, kind: str) -> NDArray[np.float64]:
    """(H, W) depths of ``kind``: any values, few values, hardly different ones, a single value, or some too far to splat."""
    if kind == "ties":
        return np.asarray(rng.choice([0.0, -0.0, 0.25, 0.5], size), np.float64)
    if kind == "close":
        first, step = ((0.5, 2.0**-18), (2.0**-8, 2.0**-31))[rng.integers(2)]  # the latter as near as float32 has them
        return np.asarray(first + rng.integers(0, 8, size) * step, np.float64)
    if kind == "flat":
        return np.full(size, rng.random(dtype=np.float32), np.float64)
    depth = rng.random(size, dtype=np.float32).astype(np.float64)
    return np.where(rng.random(size) < 0.3, 10 + depth, depth) if kind == "far" else depth


@st.composite
def rrm_inputs(draw: st.DrawFn, largest: int = 20) -> Inputs:
    """Stage rrm with any rectangle in the frame, from one pixel to the whole frame."""
    height, width = size = draw(sizes(largest))
    h, w = draw(st.integers(1, height)), draw(st.integers(1, width))
    corner = draw(st.integers(0, height - h)), draw(st.integers(0, width - w))
    return {"valid": draw(masks(size)).astype(np.uint8), "rectangle": np.array([*corner, h, w], np.int32)}


@st.composite
def accumulate_inputs(draw: st.DrawFn, largest: int = 10, before: str = "any", motion: str = "any") -> Inputs:
    """Stage accumulate: one or two earlier images, each within the box, beside it, far outside, or the same as the image.

    Args:
        draw: Hypothesis's function.
        largest: rows and columns of the motion, at most.
        before: ``same`` or any.
        motion: ``still``, ``out`` of the frame at every pixel, or any.
    """
    size = draw(sizes(largest))
    image = draw(colors((2 * size[0], 2 * size[1]), 3))
    count = draw(st.integers(1, len(EARLIER_SHARES)))
    earlier = [draw(_earlier_images(image, before)) for _ in range(count)]
    return {"image": image, "earlier": np.stack(earlier), "motions": np.stack([draw(_moved(size, motion)) for _ in earlier])}


@st.composite
def _earlier_images(draw: st.DrawFn, image: Plane, before: str) -> Plane:
    kind = draw(st.sampled_from(["same", "near", "beside", "beside", "any"])) if before == "any" else before
    if kind in ("near", "beside"):
        apart = np.random.default_rng(draw(SEEDS)).uniform(-1, 1, image.shape) * np.ptp(image)
        return image + apart * (0.1 if kind == "near" else draw(st.sampled_from([0.5, 3.0])))
    return draw(colors(image.shape[:2], 3)) if kind == "any" else image


@st.composite
def _moved(draw: st.DrawFn, size: Size, motion: str) -> Plane:
    if motion == "out":
        rng = np.random.default_rng(draw(SEEDS))
        moved, axis = rng.uniform(-1, 1, (*size, 2)), rng.integers(2, size=size)[..., None] == np.arange(2)
        far = 2.0 * np.array(size[::-1]) * rng.choice([1.0, 9.0, np.inf], size)[..., None]
        return np.where(axis, np.copysign(far, moved), moved)
    short = [motions(size, broken=True), dyadic_motions(size, "short"), dyadic_motions(size, "half")]
    return draw(dyadic_motions(size, "still") if motion == "still" else st.one_of(*short))


@st.composite
def network_inputs(draw: st.DrawFn, stage: str, size: st.SearchStrategy[Size] | None = None, color: str = "any") -> Inputs:
    """The inputs of ``stage``: history, encoder, erm, decoder or network."""
    height, width = draw(multiples() if size is None else size)
    rng = np.random.default_rng(draw(SEEDS))
    full, eighth = (height, width), (-(-height // 8), -(-width // 8))
    mask = draw(masks(full)).astype(np.float64)
    if draw(st.integers(0, 3)) == 0:
        mask = rng.random(full)  # the network accepts any number as a mask
    inputs: Inputs = {}
    if stage in ("encoder", "decoder", "network"):
        inputs["color"] = draw(colors(full, 6, color))
    if stage in ("encoder", "erm", "network"):
        inputs["gbuffer"] = _gbuffer(draw, rng, full)
        inputs["mask"] = mask
    if stage in ("history", "network"):
        valid = (rng.random((3, *full, 1)) < draw(st.sampled_from([0.0, 0.5, 1.0]))).astype(np.float64)
        inputs["history"] = np.concatenate([np.stack([draw(colors(full, 3)) for _ in range(3)]), valid], axis=-1)
    reach = draw(st.sampled_from([1.0, 1.0, 1.0, 1e6]))  # 1e6: float16 ends below it, and some ports clamp there
    if stage == "erm":
        inputs["x4"] = rng.normal(0, reach, (*eighth, 32))
    if stage == "decoder":
        shapes = {"reshaded": (*eighth, 64), "feature": (*eighth, 32), "x1": (height, width, 24)}
        shapes |= {"x2": (height // 2, width // 2, 24), "x3": (height // 4, width // 4, 32)}
        inputs |= {name: np.maximum(rng.normal(0, reach, shape), 0) for name, shape in shapes.items()}
    return inputs


@st.composite
def frame_inputs(
    draw: st.DrawFn, size: st.SearchStrategy[Size] | None = None, steps: tuple[int, int, int] | None = None
) -> Inputs:
    """Stage frame: SF, EF and missing frames; motion has halves and quarters, so that rounding decides no hole."""
    full = draw(sizes(16) if size is None else size)
    rng = np.random.default_rng(draw(SEEDS))
    back = steps or draw(
        st.sampled_from([(0, 2, 4), (1, 3, 5), (0, 0, 0), (1, 1, 1), (0, 2, 2), (1, 3, 3), (0, 1, 2), (2, 3, 5)])
    )
    reach = draw(st.sampled_from(["still", "whole", "half", "short"]))
    position = rng.integers(-200, 200, (*full, 3)) / 4
    positions = position + rng.integers(-40, 40, (4, *full, 3)) / 2 * draw(st.sampled_from([0, 1, 4]))
    objects = draw(st.sampled_from(["ground", "one", "many"]))
    stencils = [_stencil(rng, full, objects)] * 4 if draw(st.booleans()) else [_stencil(rng, full, objects) for _ in range(4)]
    normals = [_normals(draw, rng, full)] * 4 if draw(st.booleans()) else [_normals(draw, rng, full) for _ in range(4)]
    color = draw(st.sampled_from(["unit", "unit", "negative", "bright"]))
    return {
        "colors": np.stack([draw(colors(full, 3, color)) for _ in range(3)]),
        "steps": np.array(back, np.int32),
        "motions": np.stack([draw(dyadic_motions(full, reach)) for _ in range(max(1, *back))]),
        "gbuffer": _gbuffer(draw, rng, full),
        "nov": rng.uniform(-1, 1, full),
        "stencils": np.stack(stencils),
        "normals": np.stack(normals),
        "positions": positions,
    }


@st.composite
def scene_inputs(draw: st.DrawFn) -> Inputs:
    """Stage frame on a small analytic scene, with exact motion of a camera and of objects, with real holes and with cuts."""
    name, number = draw(st.sampled_from(sorted(SCENES))), draw(st.integers(5, 12))
    size = draw(st.tuples(st.integers(4, 14), st.integers(4, 14)))
    back = draw(st.sampled_from([(0, 2, 4), (1, 3, 5), (1, 1, 1)]))
    frames = [_rendered(name, number - step, size) for step in range(max(back) + 1)]
    now = frames[0]
    depth = np.where(np.isfinite(now.depth), now.depth, 0)
    depth = depth / max(depth.max(), 1e-6)
    rest = np.stack([depth, now.roughness, now.metallic], axis=-1)
    views = [now, *(frames[step] for step in back)]
    return {
        "colors": np.stack([np.clip(frames[step].color, 0, 1) for step in back]),
        "steps": np.array(back, np.int32),
        "motions": np.stack([frame.motion for frame in frames[: max(back)]]),
        "gbuffer": np.concatenate([now.normal, rest, now.base_color], axis=-1),
        "nov": now.nov,
        "stencils": np.stack([frame.stencil for frame in views]),
        "normals": np.stack([frame.normal for frame in views]),
        "positions": np.stack([frame.position for frame in views]),
    }


@lru_cache(512)
def _rendered(name: str, number: int, size: Size) -> Rendered:
    return render(SCENES[name], number, *size)


@st.composite
def weights(draw: st.DrawFn) -> Weights:
    """Draw one of a few sets of weights, so that a port need not upload new ones for every case."""
    return make_weights(draw(st.sampled_from(WEIGHT_KINDS)), draw(st.integers(0, 2)))


@st.composite
def frame_weights(draw: st.DrawFn) -> Weights:
    """The same for stage frame, with each second colour, hole test and hole fill."""
    kind, second, test, fill = (
        draw(st.sampled_from(WEIGHT_KINDS)),
        draw(st.sampled_from(SECOND_COLORS)),
        draw(st.sampled_from(HOLE_TESTS)),
        draw(st.sampled_from(HOLE_FILLS)),
    )
    return make_weights(kind, 0, second, test, fill)


@lru_cache(128)
def make_weights(
    kind: str,
    seed: int,
    second: SecondColor = "newest",
    test: HoleTest = "footprint",
    fill: HoleFill = "occlusion_warp",
) -> Weights:
    """Weights of ``stss_ref.weights.random``, as they are, thinned out, enlarged, or with keys near the clamps of spec 8.

    Those that differ in their choices alone share their arrays.
    """
    return Weights(_tensors(kind, seed), second, test, fill)


@lru_cache(32)
def _tensors(kind: str, seed: int) -> Tensors:
    tensors = dict(random(seed))
    rng = np.random.default_rng(seed)
    for name in TENSORS:
        if kind == "sparse":
            tensors[name] = np.where(rng.random(tensors[name].shape) < 0.1, tensors[name] * 3, 0).astype(np.float32)
        elif kind == "large":
            tensors[name] = tensors[name] * np.float32(2)
        elif kind in ("small keys", "faint keys") and name.startswith("KEncoder.4"):
            tensors[name] = tensors[name] * np.float32(1e-6 if kind == "small keys" else 1e-11)
    return check(tensors).tensors


def _stencil(rng: np.random.Generator, size: Size, kind: str) -> NDArray[np.float64]:
    if kind == "ground":
        return np.zeros(size)
    return (rng.integers(0, 4, size) if kind == "many" else (rng.random(size) < 0.5) * 2).astype(np.float64)


def _normals(draw: st.DrawFn, rng: np.random.Generator, size: Size) -> NDArray[np.float64]:
    """(H, W, 3) normals: of unit length, all the same, some of them 0, of length 3, denormal, or all 0."""
    normal = rng.normal(0, 1, (*size, 3))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-3)
    kind = draw(st.sampled_from(["unit", "unit", "flat", "some zero", "long", "denormal", "zero"]))
    if kind == "flat":
        normal = np.broadcast_to(normal[:1, :1], normal.shape)
    factor = {"long": 3.0, "denormal": 1e-39, "zero": 0.0}.get(kind, 1.0)
    if kind == "some zero":
        normal = np.where(rng.random((*size, 1)) < 0.4, 0, normal)
    return np.asarray(normal * factor, np.float64)


def _gbuffer(draw: st.DrawFn, rng: np.random.Generator, size: Size) -> NDArray[np.float64]:
    """(H, W, 9): normal 3, depth, roughness, metallic, base colour 3, which may be 0 everywhere."""
    rest = rng.random((*size, 6))
    if draw(st.booleans()):
        rest[..., 3:] = 0
    rest[..., 0] = depths(rng, size, draw(st.sampled_from(["any", "ties", "flat"])))
    return np.concatenate([_normals(draw, rng, size), rest], axis=-1)
