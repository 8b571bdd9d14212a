# SPDX-License-Identifier: MIT
"""The paper's ablation: short runs from random weights that differ in one part, and the mean PSNR of each over several seeds."""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from training.augment import AUGMENTS
from training.command import command
from training.data import KINDS, Batches, Kind, Shard, load_shards
from training.step import Aims, advance
from training.train import Settings, infancy, rate_at, start
from training.validate import Means, tensors, validate

ROWS = ("whole", "gbuffer", "history", "masking", "erm", "EF", "SF")
"""The parts that are left out; the last two: trained without EFs, and without SFs."""


def without_attention(light: Tensor, _material: Tensor, mask: Tensor) -> Tensor:
    """`Network.attend` without the attention: its values."""
    return light * mask


def run(row: str, shards: list[Shard], settings: Settings, steps: int, most: int) -> Means:
    """Train without ``row`` and score the running mean of the weights; the G-buffer is left out as zeros."""
    device, kinds = torch.device("cpu"), tuple[Kind, ...](kind for kind in KINDS if kind != row)
    state, keep = start(settings, device), float(row != "gbuffer")
    if row == "erm":
        state.network.attend = without_attention
    batches = Batches(shards, side=48, batch=6, seed=settings.seed, kinds=kinds, masking=row != "masking", how=settings.augment)
    for step, batch in batches.between(0, steps):
        color, gbuffer, *others = tensors(batch, device)
        aims = Aims(half=settings.half, young=infancy(step, steps))
        advance(state, (color, gbuffer * keep, *others), rate_at(step, steps, settings), aims)
    state.network.load_state_dict(state.average)
    return validate(lambda c, g, m, h: state.network(c, g * keep, m, h), shards, "validation", most=most, device=device)


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.ablate``."""
    parser = argparse.ArgumentParser(prog="python -m training.ablate", description=__doc__)
    parser.add_argument("data", type=Path, help="folder of shards, made by python -m training.samples")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=ROWS, help="the parts to leave out, one a row")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--augment", choices=AUGMENTS, default="all", help="changes of the crops; none: for one scene")
    parser.add_argument("--half", action="store_true", help="bfloat16")
    parser.add_argument("--threads", type=int, default=0, help="threads of the CPU; 0: PyTorch's choice")
    parser.add_argument("--most", type=int, default=24, help="validation frames of each kind")
    options = parser.parse_args(arguments)
    if options.threads:
        torch.set_num_threads(options.threads)
    shards = load_shards(options.data)
    torch.set_flush_denormal(True)  # see training.train
    for row in options.rows:
        settings_of_seeds = (
            Settings(48, 6, 0.01, 100, seed, options.half, history=row != "history", augment=options.augment)
            for seed in options.seeds
        )
        scores = [run(row, shards, settings, options.steps, options.most) for settings in settings_of_seeds]
        for name in (name for name in (*KINDS, "EF holes") if name.split()[0] != row and name in scores[0]):
            values = [means[name] for means in scores]
            sys.stdout.write(f"without {row}, {name}: {statistics.mean(values):.2f} ({max(values) - min(values):.2f})\n")
        sys.stdout.flush()


if __name__ == "__main__":
    command(main)
