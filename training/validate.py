# SPDX-License-Identifier: MIT
"""Measure the PSNR of SF and EF over whole frames as `stss compare` does, beside the PSNR of bilinear upsampling."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from stss.quality.metrics import mean_scores, score, upsample_holes
from stss.weights.file import load
from stss_ground.errors import InputError
from stss_ref.constants import HOLE_TESTS
from training.augment import Batch
from training.command import command
from training.data import KINDS, Shard, StoredSample, load_shards, places, spread, whole
from training.network import Network, base, load_weights

Model = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
Means = dict[str, float]
"""``SF``, ``EF`` and, over the warping holes, ``EF holes``: PSNR over R, G and B, dB; ``SF ssim``, ``EF ssim``: of the luma."""


def bilinear(color: Tensor, gbuffer: Tensor, mask: Tensor, history: Tensor) -> Tensor:
    """The network without its residual."""
    return base(color)


def tensors(batch: Batch, device: torch.device) -> tuple[Tensor, ...]:
    """The batch on the device, with channels last in memory, as convolutions run fastest."""
    parts = [torch.from_numpy(array).to(device, non_blocking=True) for array in batch]
    return tuple(t.contiguous(memory_format=torch.channels_last) if t.ndim == 4 else t for t in parts)


def validate(
    model: Callable[..., Tensor],
    shards: list[Shard],
    split: str,
    *,
    most: int,
    device: torch.device,
    reads: tuple[int, ...] = (0, 1, 2, 3),
) -> Means:
    """Mean scores over at most ``most`` frames of each kind, spread over the scenes of the split.

    ``reads``: the parts of a `training.augment.Batch` that the model takes; a `Model` takes the first four.

    Raises:
        InputError: the split lacks SF or EF samples.
    """
    means: Means = {}
    for kind in KINDS:
        sample = spread(places(shards, split, kind), most)
        if not sample:
            raise InputError(f"split {split}: no {kind} samples")
        scores = mean_scores([_score(model, place, device, reads) for place in sample])
        for name, value in (
            (kind, scores["all"].psnr_rgb),
            (f"{kind} holes", scores["holes"].psnr_rgb),
            (f"{kind} ssim", scores["all"].ssim),
        ):
            if value is not None:
                means[name] = round(value, 4)
    return means


def _score(model: Callable[..., Tensor], place: StoredSample, device: torch.device, reads: tuple[int, ...]):
    batch = whole(place)
    parts = tensors(batch, device)
    with torch.no_grad():
        image = model(*(parts[i] for i in reads))[0].float().cpu().numpy()
    truth = np.moveaxis(batch.truth[0], 0, -1)
    height, width, _ = truth.shape
    hole = batch.mask[0, 0, : height // 2, : width // 2] == 0
    return score(np.moveaxis(image, 0, -1)[:height, :width], truth, upsample_holes(hole))


def evaluating(state: dict[str, Tensor], like: Network) -> Model:
    """A network like ``like``, with the tensors of ``state``."""
    copy = Network(like.without, like.second_color).to(next(iter(state.values())).device).to(memory_format=torch.channels_last)
    copy.load_state_dict(state)
    return copy.eval()


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.validate``."""
    parser = argparse.ArgumentParser(prog="python -m training.validate", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--weights", help="safetensors file, or the name of a set; default: bilinear alone")
    parser.add_argument(
        "--split", default="validation", help="test: once, at the end", choices=("training", "validation", "test")
    )
    parser.add_argument("--most", type=int, default=10**6, help="frames of each kind")
    options = parser.parse_args(arguments)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    source: str | None = options.weights
    weights, models = None if source is None else load(source).weights, dict[str, Model](bilinear=bilinear)
    shards = load_shards(options.data, weights)
    if source is not None and weights is not None:
        if weights.hole_test != HOLE_TESTS[0]:
            reason = f"expected weights with the hole test {HOLE_TESTS[0]}, as the samples have it, found {weights.hole_test}"
            raise InputError(f"{source}: {reason}; stss methods measures them")
        models[source] = network = Network().to(device)
        load_weights(network, weights)
    for name, model in models.items():
        means = validate(model, shards, options.split, most=options.most, device=device)
        sys.stdout.write(f"{name}: {json.dumps(means)}\n")


if __name__ == "__main__":
    command(main)
