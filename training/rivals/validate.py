# SPDX-License-Identifier: MIT
"""Measure ExtraNet + NSRR on shards, over the same frames and holes as `training.validate` measures STSS."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from training.command import command
from training.rivals.train import load_extended, read
from training.validate import validate


def chain(extranet: nn.Module, nsrr: nn.Module, parts: tuple[Tensor, ...]) -> Tensor:
    """The image, (1, 3, 2H, 2W), of a batch of one frame: NSRR's, in EFs after ExtraNet's small frame.

    Args:
        extranet, nsrr: the networks.
        parts: color, gbuffer, mask, history, and the channels that `training.rivals.samples` adds, after the motion.
    """
    color, gbuffer, mask, history, further = parts
    frames = further[:, 2:]
    rendered = torch.equal(color[:, :3], frames[:, :3])  # an EF's first colour is a warped one
    small = frames[:, :3] if rendered else extranet(color, gbuffer, mask, history).clip(0, 1)
    return nsrr(torch.cat([small, frames[:, 3:]], 1)).clip(0, 1)


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.rivals.validate``."""
    parser = argparse.ArgumentParser(prog="python -m training.rivals.validate", description=__doc__)
    parser.add_argument("data", type=Path, help="folder made by python -m training.rivals.samples")
    for name in ("extranet", "nsrr"):
        parser.add_argument(f"--{name}", type=Path, required=True, help="weights of python -m training.rivals.train")
    parser.add_argument("--split", default="validation", choices=("training", "validation", "test"))
    options = parser.parse_args(arguments)
    extranet, nsrr = (read(name, getattr(options, name)) for name in ("extranet", "nsrr"))
    means = validate(
        lambda *parts: chain(extranet, nsrr, parts),
        load_extended(options.data),
        options.split,
        most=10**6,
        device=torch.device("cpu"),
        reads=(0, 1, 2, 3, 5),
    )
    sys.stdout.write(f"extranet+nsrr: {json.dumps(means)}\n")


if __name__ == "__main__":
    command(main)
