# SPDX-License-Identifier: MIT
"""Teach by an ensemble: what several networks make of each training frame in several turns, in the mean, beside its truth.

The truth holds what no network can know from the input, and that noise is most of a step's gradient. The mean over networks
and turns is nearer to the truth than each of them, and has none of it. ``--taught`` of `training.train` mixes it into the target of
the squared error (Hinton et al. 2015, Distilling the Knowledge in a Neural Network). Validation and test keep the truth alone.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from stss.weights.file import load
from stss_ref.arrays import Array
from training.augment import MASK, NORMAL, collate, turn_of_the_world
from training.command import command
from training.data import TAUGHT, Shard, load_shards
from training.network import Network, load_weights
from training.validate import tensors

ORIENTATIONS = 8


def turned(inputs: Array, orientation: int, angle: float) -> NDArray[np.float32]:
    """Inputs (H, W, 24) after a mirror (``orientation`` 4 to 7) and quarter turns, normals as `training.augment` turns them."""
    made = np.asarray(inputs, np.float32)
    mirrored = orientation >= ORIENTATIONS // 2
    made = np.rot90(made[:, ::-1] if mirrored else made, orientation % 4).copy()
    made[..., NORMAL] = made[..., NORMAL] @ turn_of_the_world(angle, mirrored=mirrored).T
    return made


def turned_back(picture: Array, orientation: int) -> Array:
    """The inverse of `turned` for a picture (H, W, C)."""
    picture = np.rot90(picture, -(orientation % 4))
    return picture[:, ::-1] if orientation >= ORIENTATIONS // 2 else picture


def teach(networks: Sequence[Network], inputs: Array, pictures: int, random: np.random.Generator) -> NDArray[np.float32]:
    """The mean of ``pictures`` pictures (2H, 2W, 3) of the networks in turn, from inputs (H, W, 24) turned in all ways."""
    total = np.zeros((2 * inputs.shape[0], 2 * inputs.shape[1], 3), np.float32)
    ways = [int(way) for _ in range(0, pictures, ORIENTATIONS) for way in random.permutation(ORIENTATIONS)]
    for i, way in enumerate(ways[:pictures]):
        one = turned(inputs, way, random.uniform(0, 2 * math.pi))
        height, width, _ = one.shape
        one = np.pad(one, ((0, -height % 8), (0, -width % 8), (0, 0)), mode="edge")
        nothing = np.zeros((1, 2 * one.shape[0], 2 * one.shape[1], 6), np.float32)
        batch = tensors(collate(one[None], one[None, ..., MASK], nothing), torch.device("cpu"))
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            made = networks[i % len(networks)](*batch[:4])[0].float().numpy()
        total += turned_back(np.moveaxis(made, 0, -1)[: 2 * height, : 2 * width], way)
    return total / np.float32(pictures)


def teach_shard(networks: Sequence[Network], folder: Path, shard: Shard, pictures: int) -> None:
    """Write ``taught.npy`` (N, 2H, 2W, 3), float16, whole or not at all."""
    random = np.random.default_rng(0)
    made = np.stack([teach(networks, inputs, pictures, random) for inputs in shard.inputs])
    path = folder / shard.name / TAUGHT
    temporary = path.with_name("." + TAUGHT)
    np.save(temporary, made.astype(np.float16))
    temporary.replace(path)


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.teach``."""
    parser = argparse.ArgumentParser(prog="python -m training.teach", description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="folder of shards; those of the training split are taught")
    parser.add_argument("--weights", nargs="+", required=True, help="safetensors files; one may be named twice")
    parser.add_argument("--pictures", type=int, default=12, help="of each frame, which are averaged")
    parser.add_argument("--threads", type=int, default=0, help="of the CPU; 0: PyTorch's choice")
    chosen = parser.parse_args(arguments)
    if chosen.threads:
        torch.set_num_threads(chosen.threads)
    networks: list[Network] = []
    for name in chosen.weights:
        network = Network()
        load_weights(network, load(name).weights)
        networks.append(network.eval())
    for shard in load_shards(chosen.data):
        if shard.split == "training" and shard.taught is None:
            teach_shard(networks, chosen.data, shard, chosen.pictures)
            sys.stdout.write(f"{shard.name}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    command(main)
