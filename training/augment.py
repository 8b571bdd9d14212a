# SPDX-License-Identifier: MIT
"""Make batches of stored samples: crops, turns, mirrors, exposure, colours, depths, and Random Reshading Masking (spec 6).

Motion is not an input of the network, only of the loss: it turns with the picture. Normals are in world space. Turning the picture
by 90 degrees is rolling the camera, which changes no normal. A mirrored picture shows a mirrored world, so normals are mirrored, too,
in x. Nothing defines north, so the normals of a sample are turned about the vertical axis, z, by any angle. Up stays up, but half of
the samples call it y, as half of the engines do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from stss_ref.arrays import Array
from stss_ref.detail import LUMA
from stss_ref.rrm import draw_rectangle, rrm

Random = np.random.Generator
Augment = Literal["all", "upright", "none"]
AUGMENTS: tuple[Augment, ...] = get_args(Augment)
"""The changes besides the crop: all of the above; all that a renderer's frames may show; none."""
NORMAL = slice(3, 6)
Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32)
"""Turns vectors of a world with z up into one with y up."""
DEPTH = 6
BASE_COLOR = slice(9, 12)
MASK = 23
MOTION, DETAIL = slice(24, 26), slice(26, 35)
ACROSS, DOWN, LEVEL = slice(26, 29), slice(29, 32), slice(32, 35)
COLORS = (slice(0, 3), slice(12, 15), slice(16, 19), slice(20, 23), ACROSS, DOWN, LEVEL)
"""Channels of colours: of four pictures, a mask follows each of the last three, and of the details."""
EXPOSURE = 0.3
"""Largest change of exposure: natural logarithm of the factor on display-referred values."""
MIDDLE, BACKGROUND = (0.04, 0.7), 0.999
"""Range of the new median depth of a crop, without the background."""


class Batch(NamedTuple):
    """Inputs of the network and the truth, channels first, float32.

    color (N, 9, H, W): the first colour and both second ones, "newest" and "detail"; gbuffer (N, 9, H, W), mask (N, 1, H, W) after RRM,
    history (N, 3, 4, H, W), truth (N, 3, 2H, 2W), motion (N, 2, H, W) pixels of a sample to its partner, the one beside it: 0 and 1, 2
    and 3; further channels of the shards follow.
    """

    color: NDArray[np.float32]
    gbuffer: NDArray[np.float32]
    mask: NDArray[np.float32]
    history: NDArray[np.float32]
    truth: NDArray[np.float32]
    motion: NDArray[np.float32]


def crop(inputs: Array, truth: Array, corner: tuple[int, int], side: int) -> tuple[Array, Array]:
    """The same square of inputs and truth, from ``corner`` (y, x) on; ``side`` and ``corner`` are in low-resolution pixels."""
    y, x = corner
    small, large = inputs[y : y + side, x : x + side], truth[2 * y : 2 * (y + side), 2 * x : 2 * (x + side)]
    return small.astype(np.float32), large.astype(np.float32)


def augment(
    inputs: Array,
    truth: Array,
    random: Random,
    *,
    how: Augment = "all",
    colors: Sequence[slice] = COLORS,
    motions: Sequence[slice] = (MOTION,),
) -> tuple[Array, Array]:
    """Turn and mirror crops, and change their exposure and colours, all alike; returns new float32 arrays.

    ``upright`` leaves out changes that no renderer's frames show: a camera on its side or its head, and colours that changed places. They
    help against too few films; with enough films they waste the network's capacity. ``none`` is for weights of one scene, which may learn
    its light by its normals.

    Args:
        inputs: (N, H, W, 35) or more channels.
        truth: (N, 2H, 2W, 3).
        random: the source of random numbers.
        how: the changes.
        colors, motions: the channels of colours and of motions.
    """
    if how == "none":
        return inputs.astype(np.float32), truth.astype(np.float32)
    upright = how == "upright"
    quarters, mirrored = 0 if upright else int(random.integers(4)), bool(random.random() < 0.5)
    inputs, truth = np.rot90(inputs, quarters, (1, 2)).copy(), np.rot90(truth, quarters, (1, 2)).copy()
    for _ in range(quarters):
        for part in motions:
            inputs[..., part] = inputs[..., part][..., ::-1] * np.float32([1, -1])
        inputs[..., ACROSS], inputs[..., DOWN] = inputs[..., DOWN].copy(), -inputs[..., ACROSS]
    if mirrored:
        inputs, truth = inputs[:, :, ::-1].copy(), truth[:, :, ::-1].copy()
        for part in motions:
            inputs[..., part] *= np.float32([-1, 1])
        inputs[..., ACROSS] *= -1
    inputs[..., NORMAL] = inputs[..., NORMAL] @ turn_of_the_world(random.uniform(0, 2 * math.pi), mirrored=mirrored).T
    if random.random() < 0.5:
        inputs[..., NORMAL] = inputs[..., NORMAL] @ Y_UP.T
    order = np.arange(3) if upright else random.permutation(3)
    # Display curves are nearly powers, so a factor on the light is nearly a factor on the display-referred value.
    exposure = np.float32(math.exp(random.uniform(-EXPOSURE, EXPOSURE)))
    for part in colors:
        inputs[..., part] = np.minimum(inputs[..., part][..., order] * exposure, 1)
    inputs[..., BASE_COLOR] = inputs[..., BASE_COLOR][..., order]
    inputs[..., DEPTH] = depths_at_random(inputs[..., DEPTH], random)
    return inputs, np.minimum(truth[..., order] * exposure, 1)


def depths_at_random(depth: Array, random: Random) -> Array:
    """Depth (..., H, W) in 0..1 as if the farthest thing were at another distance; one crop in four stays as it is.

    Depth is put between the smallest and the largest of a frame (spec 0): a wide plain presses all relevant depths into a twentieth
    of the range, a room fills it. A network that saw only the plain does not know the room's. Half of the crops
    are multiplied, half raised to a power, which keeps far values apart. The background stays at 1.
    """
    keep, power, middle = random.random() < 0.25, random.random() < 0.5, math.exp(random.uniform(*np.log(MIDDLE)))
    near = depth < BACKGROUND
    if keep or not near.any():
        return depth
    median = float(np.clip(np.median(depth[near]), 1e-3, 0.95))
    changed = depth ** (math.log(middle) / math.log(median)) if power else np.minimum(depth * (middle / median), 1)
    return np.where(near, changed, depth).astype(depth.dtype)


def turn_of_the_world(angle: float, *, mirrored: bool) -> NDArray[np.float32]:
    """(3, 3) matrix for normals: about z by ``angle``, after a mirror in x."""
    cos, sin, sign = math.cos(angle), math.sin(angle), -1 if mirrored else 1
    return np.array([[sign * cos, -sin, 0], [sign * sin, cos, 0], [0, 0, 1]], np.float32)


def mask_at_random(inputs: Array, random: Random) -> Array:
    """The newest frame's mask (H, W) after RRM. The masks in the history, also the newest frame's, stay unchanged."""
    height, width, _ = inputs.shape
    return np.asarray(rrm(inputs[..., MASK], draw_rectangle(height, width, random)), inputs.dtype)


def collate(inputs: Array, masks: Array, truth: Array) -> Batch:
    """Make a batch of inputs (N, H, W, 35) or more channels, masks (N, H, W) and truth (N, 2H, 2W, 3)."""
    planes = np.ascontiguousarray(np.moveaxis(inputs, -1, 1), np.float32)
    n, _, height, width = planes.shape
    details = np.float32(LUMA) @ planes[:, DETAIL].reshape(n, 3, 3, -1)
    return Batch(
        color=np.concatenate([planes[:, :3], planes[:, 20:23], details.reshape(n, 3, height, width)], axis=1),
        gbuffer=np.ascontiguousarray(planes[:, 3:12]),
        mask=np.ascontiguousarray(masks[:, None], np.float32),
        history=np.ascontiguousarray(planes[:, 12:24]).reshape(n, 3, 4, height, width),
        truth=np.ascontiguousarray(np.moveaxis(truth, -1, 1), np.float32),
        motion=np.concatenate([planes[:, MOTION], planes[:, DETAIL.stop :]], axis=1),
    )
