# SPDX-License-Identifier: MIT
"""Large frames: wider than a tile or a work-group, with more pixels than 16 bits count, and with motion of hundreds of pixels.

A random generator makes them and Hypothesis does not draw them, since a smaller case would no longer be large. The slowest come last.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from conformance.cases.planes import Size
from conformance.cases.stage_inputs import Inputs, make_weights
from stss_ref.constants import HOLE_FILLS, HoleFill
from stss_ref.weights import SECOND_COLORS, SecondColor, Weights

IMAGE_SIZES: tuple[Size, ...] = (
    *((2, 4500), (4500, 2), (270, 480), (65, 129)),
    *((540, 960), (129, 66), (65_601, 1), (1, 65_601), (1080, 1920)),
)
"""(H, W) for the image stages. The first two have as many pixels, the third more than 16 bits count. The fifth is a usual frame, which
every tier judges in windows, too (`user_inputs`). Then more columns or rows than 16 bits count."""
_OVER = 1, 7, 9, 15, 17, 23, 25, 31
ODD_SIZES: tuple[Size, ...] = tuple((32 + h, 32 + w) for h, w in zip(_OVER, (*_OVER[3:], *_OVER[:3]), strict=True))
"""(H, W) for the image stages, small: tiles of 8, 16 and 32 leave little over, nearly all, or half and a little more or less, both ways."""
STRIPS: tuple[Size, ...] = tuple(size for n in range(17, 32) for size in ((8, 8 * n), (8 * n, 8)))
"""(H, W) for stages of the network, small: at 1/8 size vectors of 16 leave 1 to 15 over, those of 8 up to 7, both ways."""
NETWORK_SIZES: tuple[Size, ...] = ((8, 2072), (2072, 8), (136, 184), (8, 528), (264, 8), (528, 64), (264, 272))
"""(H, W) for stages of the network: at 1/8 they have up to 259 rows or columns. The third has more than two tiles of 64 both ways, the
last more than 65,536 pixels. With `AGAIN`, tiles of 32 leave 8, 16 and 24 over."""
HISTORY_SIZES: tuple[Size, ...] = ((8, 2072), (2072, 8), (264, 272), (8, 528), (264, 8), (528, 64))
"""(H, W) for stage history, whose work begins at half the size."""
PLACES_SIZES: tuple[Size, ...] = ((8, 8_400), (8_400, 8), (1056, 1056), (72, 136), (528, 64))
"""(H, W) for stage erm, all of whose work is at 1/8 size: there it has up to 1,050 rows or columns, and more than two tiles of 64 both
ways."""
ANY_SIZES: tuple[Size, ...] = ((5, 1_043), (1_043, 5), (67, 131), (515, 13), (257, 259))
"""(H, W) for stages network and frame, which pad them."""
USER_SIZES: dict[str, Size] = {"quick": (720, 1280), "full": (1080, 1920)}
"""(H, W) of users' frames. At 720 x 1280 a feature of 24 channels has more numbers than float32 counts, and beside another more bytes
than 128 MiB. At 1080 x 1920 there are more pixels than 20 bits count, and more than 65,535 groups of 64 numbers."""
AGAIN: Size = (80, 104)
"""(H, W) of two frames one after the other: all of the second one's numbers are others, and tiles of 64 end in it both ways."""
TWICE = ("decoder", "network", "frame", "accumulate")
"""Stages with arrays of twice the rows and columns."""
IN_FULL = ("history", "encoder", "erm", "decoder")
"""Stages that only the full tier judges at such a size."""
IN_ANOTHER = {"network": "frame"}
"""Stages that the quick tier judges at such a size as a part of another one, where the port has that: both take as long."""
IN_QUICK: dict[str, Size] = {"encoder": (264, 272), "decoder": (264, 272)}
"""(H, W) of more than 65,536 pixels, at which the quick tier judges some of them in windows; `HISTORY_SIZES` has it for history."""
FEW = 4
"""Large frames of a quick tier."""
MOST_HOLES = 8_000
"""About the largest number of holes in a frame for stage reshade that is judged as a whole: the reference looks at 96 pixels around
each."""
FINE = np.float32(2.0**-16)
"""Pixels: a motion of a few pixels may be off a whole one by so little, and its float32 sum with a column from 256 on is whole then."""
SQUARE = 40
"""Rows and columns of an object that appears: in its middle only rings with steps of 16 and 32 pixels leave it."""
SHORT = 8
"""Longest motion of frames that are judged in windows; pixels."""
MakeCase = Callable[[Generator], Any]


def short_motion(rng: Generator, size: Size) -> NDArray[np.float64]:
    """(H, W, 2) motion of up to ``SHORT`` pixels: fractions, halves, whole pixels."""
    moved = rng.random((*size, 2), np.float32) * np.float32(2 * SHORT) - np.float32(SHORT)
    kind = rng.integers(0, 4, size, np.int8)[..., None]
    return np.select([kind == 1, kind == 2], [np.round(moved), np.round(moved * 2) / 2], moved).astype(np.float64)


def motion(rng: Generator, size: Size) -> NDArray[np.float64]:
    """(H, W, 2) motion: short, across the frame, and out of it on each side; of whole pixels and of fractions."""
    height, width = size
    reach = np.array([width, height])
    kind = rng.integers(0, 4, size)[..., None]
    across = rng.uniform(-0.9, 0.9, (*size, 2)) * reach
    out = rng.choice([-1, 1], (*size, 2)) * rng.uniform(0.5, 3, (*size, 2)) * reach
    kinds = [rng.uniform(-3, 3, (*size, 2)), across, np.round(across), out]
    return np.select([kind == i for i in range(4)], kinds).astype(np.float32).astype(np.float64)


Moving = Callable[[Generator, Size], NDArray[np.float64]]
"""Makes the motion of a frame."""


def _warp(moving: Moving, size: Size, rng: Generator) -> Inputs:
    """Three channels; nine in windows, where 1080 x 1920 pixels have more numbers than float32 counts."""
    channels = 9 if moving is short_motion else 3
    return {"color": rng.random((*size, channels), np.float32), "motion": moving(rng, size)}


def _holes(moving: Moving, size: Size, rng: Generator) -> Inputs:
    """Objects on a ground, with distances and angles near the limits of trust."""
    normal, position = rng.normal(0, 1, (*size, 3)), rng.normal(0, 15, (*size, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    stencil = (rng.random(size) < 0.3) * 2.0
    # Half of the pixels do not move, since hardly any other pixel is trusted.
    moved = np.where((rng.random(size) < 0.5)[..., None], 0, moving(rng, size))
    return {
        "motion": moved, "stencil": stencil, "stencil_previous": stencil, "normal": normal, "position": position,
        "normal_previous": normal + rng.normal(0, 0.1, normal.shape), "position_previous": position + rng.normal(0, 8, normal.shape),
        "nov": rng.uniform(-1, 1, size), "depth": rng.random(size), "paper": rng.integers(0, 2, 1, np.int32),
    }  # fmt: skip


def _occlusion_warp(moving: Moving, size: Size, rng: Generator) -> Inputs:
    color, warped = rng.random((2, *size, 3))
    depth = np.where(rng.random(size) < 0.3, 0.5, rng.random(size))
    valid = (rng.random(size) < 0.5).astype(np.uint8)
    return {"color": color, "warped": warped, "motion": moving(rng, size), "depth": depth, "valid": valid}


def _reshade(moving: Moving, size: Size, rng: Generator) -> Inputs:
    """Half of the holes have samples of their own; the rest looks around, at objects and materials of few kinds."""
    color, warped = rng.random((2, *size, 3))
    stencil = (rng.random(size) < 0.3) * 2.0
    position = rng.normal(0, 15, (*size, 3))
    normal, other = np.broadcast_to([0.0, 0.0, 1.0], (*size, 3)), np.broadcast_to([0.0, 0.6, 0.8], (*size, 3))
    valid = rng.random(size) >= (0.1 if moving is short_motion else min(0.1, MOST_HOLES / np.prod(size)))
    return {
        "color": color, "warped": warped, "motion": moving(rng, size), "valid": valid.astype(np.uint8), "stencil": stencil,
        "stencil_previous": np.where(rng.random(size) < 0.5, stencil, 7), "normal": normal, "position": position,
        "normal_previous": np.where(rng.random((*size, 1)) < 0.5, normal, other), "position_previous": position + 1000,
        "base_color": rng.integers(0, 3, (*size, 3)) / 2,
    }  # fmt: skip


def _rrm(_: Moving, size: Size, rng: Generator) -> Inputs:
    height, width = size
    rectangle = np.array([height // 4, width // 4, -(-height // 2), -(-width // 2)], np.int32)
    return {"valid": (rng.random(size) < 0.7).astype(np.uint8), "rectangle": rectangle}


def _accumulate(moving: Moving, size: Size, rng: Generator) -> Inputs:
    image, *earlier = rng.random((3, 2 * size[0], 2 * size[1], 3), np.float32)
    return {"image": image, "earlier": np.stack(earlier), "motions": np.stack([moving(rng, size) for _ in earlier])}


def network_case(stage: str, size: Size, rng: Generator) -> tuple[Inputs, Weights]:
    """Inputs of a stage of the network, in [0, 1], and weights."""
    height, width = size
    shapes = {
        "color": (height, width, 6), "gbuffer": (height, width, 9), "history": (3, height, width, 4),
        "x1": (height, width, 24), "x2": (height // 2, width // 2, 24), "x3": (height // 4, width // 4, 32),
        "x4": (height // 8, width // 8, 32), "reshaded": (height // 8, width // 8, 64), "feature": (height // 8, width // 8, 32),
    }  # fmt: skip
    names = {
        "history": ("history",), "encoder": ("color", "gbuffer"), "erm": ("x4", "gbuffer"),
        "decoder": ("reshaded", "feature", "x1", "x2", "x3", "color"), "network": ("color", "gbuffer", "history"),
    }  # fmt: skip
    assert stage in names, (
        f"{stage}: no inputs; expected a row of conformance/cases/large_inputs.py, and one of alike.py beside it"
    )
    inputs: Inputs = {name: rng.random(shapes[name], np.float32) for name in names[stage]}
    if stage in ("encoder", "erm", "network"):
        # Holes of whole blocks, too: of single ones hardly any is 0 at 1/8 size.
        blocks = rng.random((-(-height // 8), -(-width // 8))) < 0.8
        mask = blocks.repeat(8, axis=0).repeat(8, axis=1)[:height, :width] & (rng.random(size) < 0.8)
        inputs["mask"] = mask.astype(np.float64)
    return inputs, make_weights("random", 0)


def frame_case(
    size: Size,
    rng: Generator,
    second: SecondColor = "newest",
    steps: tuple[int, int, int] = (1, 3, 5),
    fill: HoleFill = "occlusion_warp",
    *,
    short: bool = False,
    fine: bool = False,
) -> tuple[Inputs, Weights]:
    """Stage frame: motion is short, in quarters, or far, in whole pixels; surfaces coincide or are far apart: rounding decides no hole.

    With ``short`` motion none is far. With ``fine`` motion the newest one is off quarters by ``FINE``: if it is short, too, no sum of
    motions rounds. Where holes are reshaded, an object appears in every third square of `SQUARE` pixels: a hole without samples.
    """
    count, single = steps[-1], np.float32
    squares = np.add.outer(*(np.arange(n) // SQUARE for n in size))
    appears = (squares % 3 == 1) & (fill == "reshade")
    far = np.round((rng.random((count, *size, 2), single) * single(1.8) - single(0.9)) * np.array(size[::-1], single))
    moved = np.where(
        (rng.random((count, *size, 1), single) < (0 if short else 0.3)) & ~appears[..., None],
        far,
        rng.integers(-6, 7, (count, *size, 2), np.int8) / single(4),
    )
    if fine:
        moved[0] += rng.integers(-1, 2, (*size, 2), np.int8) * FINE
    positions = np.zeros((4, *size, 3), single)
    positions[..., 0] = single(256) * (rng.random((4, *size), single) < 0.02)
    stencil = (rng.random(size, single) < 0.1) * single(2)
    inputs: Inputs = {
        "stencils": np.stack([stencil, *[np.where(appears, single(7), stencil)] * 3]), "positions": positions,
        "normals": np.broadcast_to(np.array([0, 0, 1], single), (4, *size, 3)), "colors": rng.random((3, *size, 3), single),
        "steps": np.array(steps, np.int32), "motions": moved, "gbuffer": rng.random((*size, 9), single),
        "nov": rng.random(size, single) * 2 - 1,
    }  # fmt: skip
    return inputs, make_weights("random", 0, second, fill=fill)


_IMAGE: dict[str, Callable[[Moving, Size, Generator], Inputs]] = {
    "motion_chain": lambda moving, size, rng: {"motions": np.stack([moving(rng, size) for _ in range(3)])},
    "warp": _warp,
    "holes": _holes, "occlusion_warp": _occlusion_warp, "reshade": _reshade, "rrm": _rrm,
    "accumulate": _accumulate,
}  # fmt: skip


def large_inputs(stage: str, most: int | None = None, size: Size | None = None, side: int | None = None) -> tuple[MakeCase, ...]:
    """The large cases of a stage: inputs, and weights if the stage takes them; the slowest last.

    Args:
        stage: its name.
        most: the number of cases that are made at sizes of this module; None: all.
        size: (H, W) of one more case; stages of the network but ``network`` and ``frame`` get the next larger multiples of 8.
        side: the most rows or columns of any array, outputs too; larger cases are cut to that, and ``size`` is left out; None: any.
    """
    scale = 2 if stage in TWICE else 1
    extra = [_fitting_size(stage, size)] if size is not None else []
    again = [AGAIN, AGAIN] if most is None or most >= FEW else []
    usual = _sizes(stage)[:most]
    odd = () if not again else ODD_SIZES if stage in _IMAGE else STRIPS if stage in IN_FULL else ()
    own = [*usual, *again, *odd, *(each for each in extra if side is None or scale * max(each) <= side)]
    largest = max(map(max, own), default=0) if side is None else side // scale // 8 * 8
    cases = [_case(stage, i, (min(height, largest), min(width, largest))) for i, (height, width) in enumerate(own)]
    if again:
        second = len(usual) + 1
        cases[second] = partial(_on_other_numbers, cases[second])
    return tuple(cases)


def _on_other_numbers(make: MakeCase, rng: Generator) -> Any:
    return make(rng.spawn(1)[0])


def user_inputs(
    stage: str, most: int, side: int | None = None, stages: Collection[str] = (), *, fine: bool = True
) -> tuple[MakeCase, ...]:
    """The cases of a stage that are judged in windows, at sizes of users: none that a port does not take; other arguments as below.

    Args:
        stages: the port's.
        fine: of `frame_case`, and not for ports in 16 bits, whose chained motion loses ``FINE``.
    """
    if most <= FEW and IN_ANOTHER.get(stage) in stages:
        return ()
    sizes = [_fitting_size(stage, size) for size in user_sizes(stage, most, side)]
    if stage == "frame":
        # Stage reshade is judged at these sizes by itself: the reference's fill of so many holes takes longer than all the rest.
        return tuple(partial(frame_case, size, second="detail", steps=(1, 2, 3), short=True, fine=fine) for size in sizes)
    if stage in _IMAGE:
        return tuple(partial(_IMAGE[stage], short_motion, size) for size in sizes)
    return tuple(partial(network_case, stage, size) for size in sizes)


def user_sizes(stage: str, most: int, side: int | None = None) -> tuple[Size, ...]:
    """Their sizes: image stages at the larger one in any tier; stages of twice the size at the smaller one in a tier of few large frames.

    Args:
        stage: its name.
        most: large frames of the tier; of fewer than four, none is of a user's size.
        side: the most rows or columns of any array; None: any.
    """
    if most < FEW:
        return ()
    quick = most <= FEW
    size = USER_SIZES["quick" if quick and stage in TWICE else "full"]
    if quick and stage in IN_FULL:
        if stage not in IN_QUICK:
            return ()
        size = IN_QUICK[stage]
    scale = 2 if stage in TWICE else 1
    return (size,) if side is None or scale * max(size) <= side else ()


def _sizes(stage: str) -> tuple[Size, ...]:
    if stage == "accumulate":  # its images are twice as large
        return tuple(size for size in IMAGE_SIZES[:-1] if size != (540, 960))
    if stage in _IMAGE:  # all of rrm's largest frame is judged, and at once
        return IMAGE_SIZES if stage != "rrm" else (IMAGE_SIZES[-1], *IMAGE_SIZES[:-1])
    if stage in ("history", "erm"):
        return PLACES_SIZES if stage == "erm" else HISTORY_SIZES
    return ANY_SIZES if stage in ("network", "frame") else NETWORK_SIZES


def _fitting_size(stage: str, size: Size) -> Size:
    """A size that the stage takes, at least ``size``."""
    height, width = size
    return size if stage in _IMAGE or stage in ("network", "frame") else (-(-height // 8) * 8, -(-width // 8) * 8)


def _case(stage: str, number: int, size: Size) -> MakeCase:
    if stage in _IMAGE:
        return partial(_IMAGE[stage], motion, size)
    if stage == "frame":
        return partial(frame_case, size, second=SECOND_COLORS[number % 2], fill=HOLE_FILLS[number % 2])
    return partial(network_case, stage, size)
