# SPDX-License-Identifier: MIT
"""Estimate what no method can remove: how far truths differ where all that a method sees of an aliased frame is the same.

A scene is rendered once at many times the size, one ray a pixel. Every pixel of a block, taken alone, gives an aliased frame: the
frames of a block are one scene, seen from places less than a pixel apart. The truth of each is the mean of the pixels around. Where
two such frames are the same, colours and G-buffer, in the surroundings of a pixel, no method that looks at these surroundings can
tell which it has, and the best that it can give is the mean of their truths. The variance of the truths is then its least squared
error. Where no two frames are the same, the estimate is 0; so it is too small, as it knows no other ambiguity than the place of the
camera. It is too large for a method that looks farther than the surroundings do.

SFs alone: what was warped differs in its holes as well.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from stss.color import transfer
from stss.frames.display_frame import DisplayFrame, prepare
from stss.sequence.reader import open_sequence
from stss.weights.file import load
from stss_ground.errors import InputError
from stss_ref.arrays import Array
from training.augment import collate
from training.command import command
from training.network import Network, load_weights
from training.samples import film_frames
from training.scenes import random_film
from training.validate import bilinear, tensors

BLOCK = 8
"""Rays across a pixel of the small frame."""
SIDES = (1, 3, 5, 9, 17)
"""Sides of the surroundings, pixels."""
Place = tuple[int, int]
PLACES = [(y, x) for y in range(BLOCK) for x in range(BLOCK)]
SAME = 2 / 255
"""Largest difference between inputs that count as the same."""


class Twins:
    """The aliased frames of one scene from `BLOCK` x `BLOCK` places, and their truths.

    Args:
        planes: (8 h, 8 w, 12), display-referred colour and G-buffer, one ray a pixel.
    """

    def __init__(self, planes: Array):
        height, width = (side // BLOCK - 1 for side in planes.shape[:2])
        if min(height, width) < 1:
            raise InputError(f"expected frames of {2 * BLOCK} x {2 * BLOCK} or more, got {planes.shape[1]} x {planes.shape[0]}")
        self.size, self._planes = (height, width), planes.astype(np.float32)
        half = BLOCK // 2
        self._rows, self._columns = (np.arange(2 * n) * half for n in self.size)
        # A frame's ray lies in the middle of its pixel, so the pixels' edges go through the middle of rays: these count half on each side.
        means = self._planes[..., :3].astype(np.float64)
        for axis in (0, 1):
            sums = np.moveaxis(np.pad(means.cumsum(axis), [(1, 0) if axis == a else (0, 0) for a in range(3)]), axis, 0)
            windows = (sums[half:] - sums[:-half]) / half
            means = np.moveaxis((windows[1:] + windows[:-1]) / 2, 0, axis)
        self._means = means.astype(np.float32)

    def inputs(self, y: int, x: int) -> NDArray[np.float32]:
        """The frame (h, w, 12) from place (``y``, ``x``), its first ray half a block from the corner of the picture, or more."""
        (height, width), half = self.size, BLOCK // 2
        return self._planes[half + y :: BLOCK, half + x :: BLOCK][:height, :width]

    def truth(self, y: int, x: int) -> NDArray[np.float32]:
        """Its truth (2h, 2w, 3), the mean of 16 rays a pixel."""
        return self._means[self._rows + y][:, self._columns + x]


def alike(a: Array, b: Array, sides: Sequence[int] = SIDES) -> list[NDArray[np.bool_]]:
    """Where the surroundings of each pixel are the same in both inputs (h, w, C), for each side. Beyond the frame, all is the same."""
    apart = np.pad((np.abs(a - b) > SAME).any(-1).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    height, width = a.shape[:2]
    found: list[NDArray[np.bool_]] = []
    for side in sides:
        (top, bottom), (left, right) = (
            (np.clip(np.arange(n) - side // 2, 0, n), np.clip(np.arange(n) + side // 2 + 1, 0, n)) for n in (height, width)
        )
        found.append(apart[bottom][:, right] - apart[top][:, right] - apart[bottom][:, left] + apart[top][:, left] == 0)
    return found


def spread_of_truths(twins: Twins, places: Sequence[Place], sides: Sequence[int] = SIDES) -> NDArray[np.float64]:
    """The mean squared error that remains in the frames from some places for whoever sees surroundings of each side."""
    height, width = twins.size
    truths = {place: _pixels(twins.truth(*place), twins.size) for place in PLACES}
    remaining = np.zeros(len(sides))
    for place in places:
        count, second = np.zeros((2, len(sides), height, width), np.float32)
        total = np.zeros((len(sides), height, width, 12), np.float32)
        for other in PLACES:
            # Differences from the place's own truth, so that their squares lose no digits.
            difference = truths[other] - truths[place]
            for i, same in enumerate(alike(twins.inputs(*place), twins.inputs(*other), sides)):
                count[i] += same
                total[i] += difference * same[..., None]
                second[i] += np.square(difference).sum(-1) * same
        first = np.square(total / count[..., None]).sum(-1)
        remaining += ((second / count - first) / 12).mean((1, 2))
    return remaining / len(places)


def _pixels(truth: Array, size: tuple[int, int]) -> Array:
    """(2h, 2w, 3) as (h, w, 12)."""
    height, width = size
    return truth.reshape(height, 2, width, 2, 3).swapaxes(1, 2).reshape(height, width, 12)


def errors(twins: Twins, network: Network, places: Sequence[Place]) -> tuple[float, float]:
    """The mean squared errors of bilinear and of a network that does not read the history, on the frames as SFs."""
    made: list[tuple[float, float]] = []
    for place in places:
        seen, truth = twins.inputs(*place), twins.truth(*place)
        below, right = (-length % 8 for length in seen.shape[:2])
        inputs = np.zeros((*seen.shape[:2], 24), np.float32)
        # What was warped is the frame itself: nothing is older in an SF's colour, and no pixel is a hole.
        inputs[..., :12], inputs[..., 20:23], inputs[..., [15, 19, 23]] = seen, seen[..., :3], 1
        inputs = np.pad(inputs, ((0, below), (0, right), (0, 0)), mode="edge")
        batch = tensors(collate(inputs[None], inputs[None, ..., 23], truth[None]), torch.device("cpu"))[:4]
        with torch.no_grad():
            pictures = [model(*batch)[0].numpy() for model in (bilinear, network)]
        height, width, _ = truth.shape
        base, own = (float(np.square(np.moveaxis(p, 0, -1)[:height, :width] - truth).mean()) for p in pictures)
        made.append((base, own))
    base, own = np.mean(made, axis=0)
    return float(base), float(own)


def planes_of(frame: DisplayFrame) -> Array:
    """Colour and G-buffer (H, W, 12)."""
    if frame.color is None:
        raise InputError(f"frame {frame.number} has no colour")
    return np.concatenate([frame.color, frame.gbuffer], axis=-1)


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.bound``."""
    parser = argparse.ArgumentParser(prog="python -m training.bound", description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("frames", type=Path, nargs="*", help=f"folders of frames at {BLOCK} times the size, one ray a pixel")
    parser.add_argument("--profile", default="blender")
    parser.add_argument("--camera", type=Path, help="of the frames, where the profile needs it")
    parser.add_argument("--analytic", type=int, default=0, metavar="N", help="the first frame of N analytic films as well")
    parser.add_argument("--first", type=int, default=0, help="number of the first film")
    parser.add_argument("--size", default="160x96", help="WxH of the films' small frames")
    parser.add_argument("--places", type=int, default=4, help="of the 64, whose frames are compared with all")
    parser.add_argument("--weights", default="realtime", help="safetensors file, of a network that does not read the history")
    chosen = parser.parse_args(arguments)
    places = [PLACES[i] for i in np.random.default_rng(0).permutation(len(PLACES))[: chosen.places]]
    network = Network()
    load_weights(network, load(chosen.weights).weights)
    network.eval()
    curve, width_height = transfer("srgb"), chosen.size.split("x")
    size = BLOCK * int(width_height[1]), BLOCK * int(width_height[0])
    shown: list[tuple[str, Twins]] = []
    for folder in chosen.frames:
        sequence = open_sequence(folder, chosen.profile, camera=chosen.camera)
        shown.append((str(folder), Twins(planes_of(prepare(sequence.load(sequence.numbers[0]), curve, "scale")))))
    for seed in range(chosen.first, chosen.first + chosen.analytic):
        (buffers,) = film_frames(random_film(seed, "aliased"), size, 1)
        shown.append((f"film {seed}", Twins(planes_of(prepare(buffers, curve, "scale")))))
    _table(shown, network, places)


def _table(shown: Sequence[tuple[str, Twins]], network: Network, places: Sequence[Place]) -> None:
    heads = ["", "bilinear", "network", *(f"{side} x {side}" for side in SIDES)]
    sys.stdout.write("Squared error / 1e-4: of two methods, and of the best that sees no more than such surroundings\n\n")
    sys.stdout.write(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}\n")
    rows: list[list[float]] = []
    for name, twins in shown:
        rows.append([*errors(twins, network, places), *spread_of_truths(twins, places)])
        _row(name, rows[-1])
    if rows:
        _row("mean", [float(v) for v in np.mean(rows, axis=0)])


def _row(name: str, values: Sequence[float]) -> None:
    sys.stdout.write(f"| {name} | " + " | ".join(f"{1e4 * v:.2f}" for v in values) + " |\n")
    sys.stdout.flush()


if __name__ == "__main__":
    command(main)
