# SPDX-License-Identifier: MIT
"""The paper's ablations on our data: short runs from random weights that differ in one thing, and a table of their scores."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from training.command import command
from training.data import KINDS, Batches, Kind, Shard, load_shards
from training.step import Aims, advance
from training.train import Settings, infancy, rate_at, start
from training.validate import Means, bilinear, evaluating, tensors, validate


@dataclass(frozen=True)
class Variant:
    """A row of the table: the part that is left out (see `training.network.Network`), the frames trained on, and whether RRM is used."""

    name: str
    without: str = ""
    kinds: tuple[Kind, ...] = KINDS
    masking: bool = True


VARIANTS = (
    Variant("whole"),
    Variant("without G-buffer", without="gbuffer"),
    Variant("without history", without="history"),
    Variant("without RRM", masking=False),
    Variant("without ERM", without="erm"),
    Variant("SF alone", kinds=("SF",)),
    Variant("EF alone", kinds=("EF",)),
)
COLUMNS = ("SF", "SF ssim", "EF", "EF ssim", "EF holes")


def run(variant: Variant, shards: list[Shard], settings: Settings, steps: int, device: torch.device) -> dict[str, torch.Tensor]:
    """Train one variant; returns the running mean of its tensors."""
    state = start(settings, device, without=variant.without)
    batches = Batches(
        shards, side=settings.crop, batch=settings.batch, seed=settings.seed, kinds=variant.kinds, masking=variant.masking
    )
    for step, batch in batches.between(0, steps):
        young, rate = infancy(step, steps), rate_at(step, steps, settings)
        advance(state, tensors(batch, device), rate, Aims(half=settings.half, young=young))
    return state.average


def row(name: str, means: Means, kinds: Sequence[str]) -> str:
    """A line of the table in Markdown; columns that a network was not trained for stay empty."""
    shown = ((f"{means[c]:.4f}" if "ssim" in c else f"{means[c]:.2f}") if c in means and c[:2] in kinds else "" for c in COLUMNS)
    return f"| {name} | " + " | ".join(shown) + " |"


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.ablate``."""
    parser = argparse.ArgumentParser(prog="python -m training.ablate", description=__doc__)
    parser.add_argument("data", type=Path, help="folder of shards, made by python -m training.samples")
    parser.add_argument("--judge", type=Path, help="folder of other shards to be scored on; default: data")
    parser.add_argument("--split", default="test", choices=("validation", "test"), help="that is scored")
    parser.add_argument("--only", default="", help="variants with this in their name")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--crop", type=int, default=80)
    parser.add_argument("--batch", type=int, default=6)
    parser.add_argument("--rate", type=float, default=0.01)
    parser.add_argument("--warm-up", type=int, default=200)
    parser.add_argument("--most", type=int, default=64, help="scored frames of each kind")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--half", action="store_true", help="bfloat16")
    parser.add_argument("--threads", type=int, default=0, help="of the CPU; 0: PyTorch's choice")
    chosen = parser.parse_args(arguments)
    if chosen.threads:
        torch.set_num_threads(chosen.threads)
    device, shards = torch.device(chosen.device), load_shards(chosen.data)
    judge = load_shards(chosen.judge) if chosen.judge else shards
    settings = Settings(chosen.crop, chosen.batch, chosen.rate, chosen.warm_up, 0, chosen.half)

    def say(text: str) -> None:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()

    say("| | " + " | ".join(COLUMNS) + " |\n" + "|---" * (len(COLUMNS) + 1) + "|")
    say(row("bilinear", validate(bilinear, judge, chosen.split, most=chosen.most, device=device), KINDS))
    for variant in VARIANTS:
        if chosen.only in variant.name:
            average = run(variant, shards, settings, chosen.steps, device)
            means = validate(evaluating(average, variant.without), judge, chosen.split, most=chosen.most, device=device)
            say(row(variant.name, means, variant.kinds))


if __name__ == "__main__":
    command(main)
