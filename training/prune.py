# SPDX-License-Identifier: MIT
"""Replace all features below half size by their means, and set the kernels that nothing reads afterwards to exactly 0.

Programs leave out layers that only kernels of 0 read (`stss_cl.liveness.find_live`), so frames are computed faster, and with the same bits.
Numbers that are tiny become 0, too (`stss_cl.liveness.drop_tiny`).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from stss.weights.file import ALIASED, MADE_FOR, load, save
from stss_cl.liveness import drop_tiny, find_live
from stss_ground.output.places import require_places
from stss_ref.weights import LAYERS, Weights
from training.command import command
from training.data import KINDS, Shard, load_shards, places, spread, whole
from training.network import Network, load_weights
from training.validate import tensors

READER = "up2.conv.double_conv.0"
"""The one layer that reads both half size and features below it."""
FRAMES = 200
"""Frames of each kind, enough for a mean."""


def mean_below(weights: Weights, shards: list[Shard]) -> np.ndarray:
    """(32,) mean of the features below half size that it reads, over the training split's SFs and EFs."""
    network, means = Network(), list[torch.Tensor]()
    load_weights(network, weights)
    with torch.no_grad():
        for place in (p for kind in KINDS for p in spread(places(shards, "training", kind), FRAMES)):
            _, features = network.residual(*tensors(whole(place), torch.device("cpu"))[:4])
            means.append(features["up1"].mean((0, 2, 3)))
    return torch.stack(means).mean(0).numpy()


def prune(weights: Weights, mean: np.ndarray) -> Weights:
    """The weights of a network that sees ``mean`` (32,) everywhere in place of the features below half size.

    At the frame's rim kernels also see the mean, where the network has zeros.
    """
    kernel, bias = weights[f"{READER}.weight"].copy(), weights[f"{READER}.bias"].copy()
    bias += np.einsum("oiyx,i->o", kernel[:, -len(mean) :], mean)
    kernel[:, -len(mean) :] = 0
    pruned = drop_tiny(weights | {f"{READER}.weight": kernel, f"{READER}.bias": bias})
    runs = find_live(pruned).layers
    dead = [layer for layer in LAYERS if layer.name not in runs]
    return pruned | {name: np.zeros(shape, np.float32) for layer in dead for name, shape in layer.tensors()}


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.prune``."""
    parser = argparse.ArgumentParser(prog="python -m training.prune", description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="folder of shards, made by python -m training.samples")
    parser.add_argument("--weights", required=True, help="safetensors file, or the name of a set")
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    require_places({"--out": options.out}, [options.data, Path(options.weights)])
    loaded = load(options.weights)
    pruned = prune(loaded.weights, mean_below(loaded.weights, load_shards(options.data, loaded.weights)))
    made_for = {MADE_FOR: ALIASED} if loaded.made_for_aliased else {}
    save(options.out, pruned, {"pruned": "below half size", "average_of": json.dumps([dict(loaded.metadata)]), **made_for})


if __name__ == "__main__":
    command(main)
