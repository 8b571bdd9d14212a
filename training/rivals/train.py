# SPDX-License-Identifier: MIT
"""Train ExtraNet and NSRR as `training.train` trains STSS: its batches, augmentation, loss, optimisers, rates and running mean."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import cast

import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from stss_ground.errors import InputError
from training.augment import COLORS, MOTION, augment
from training.command import command
from training.data import Batches, Kind, load_shards
from training.initial import hold_gates, initialise
from training.loss import STRUCTURE, loss, squared, structure, trusted
from training.network import Network, leak
from training.rivals.networks import EARLIER, NSRR, PLANES, ExtraNet, extrapolated, supersampled
from training.step import ADAM, AVERAGE, CLIP, LEAK
from training.train import Settings, infancy, optimisers, rate_at
from training.validate import tensors

FRAMES = MOTION.stop
"""The first of NSRR's channels in a shard."""
ALL_COLORS = (*COLORS, *(slice(FRAMES + 4 * i, FRAMES + 4 * i + 3) for i in range(EARLIER + 1)))
ALL_MOTIONS = (MOTION, *(slice(FRAMES + PLANES + 2 * i, FRAMES + PLANES + 2 * i + 2) for i in range(EARLIER)))
NETWORKS: dict[str, Callable[[], nn.Module]] = {"extranet": ExtraNet, "nsrr": NSRR}
KINDS: dict[str, tuple[Kind, ...]] = {"extranet": ("EF",), "nsrr": ("SF", "EF")}
"""What each trains on. NSRR's EFs have the frame itself as newest, for which ExtraNet's stands later."""


def make(name: str, seed: int = 0) -> nn.Module:
    """A network of `NETWORKS` with random weights, near the picture that it adds to."""
    network = NETWORKS[name]()
    initialise(network, seed)
    if name == "extranet":
        hold_gates(cast(Network, network))
    return network


def batches(data: Path, name: str, side: int, batch: int, seed: int) -> Batches:
    """The batches of a network; ``data`` is a folder of `training.rivals.samples`."""
    shards = load_shards(data)
    if shards[0].inputs.shape[-1] != FRAMES + PLANES + 2 * EARLIER:
        raise InputError(f"{data}: expected shards of python -m training.rivals.samples")
    made = Batches(shards, side=side, batch=batch, seed=seed, kinds=KINDS[name], masking=False)
    made.augment = partial(augment, colors=ALL_COLORS, motions=ALL_MOTIONS)
    return made


def objective(name: str, network: nn.Module, batch: tuple[Tensor, ...], young: float, *, half: bool) -> Tensor:
    """The loss of a batch of `batches`, as `training.step.objective` takes it of STSS; ExtraNet aims at the rendered small frame."""
    color, gbuffer, mask, history, truth, further = batch
    frames = further[:, 2:]
    with torch.autocast(color.device.type, torch.bfloat16, enabled=half):
        if name == "extranet":
            output, truth, trust = extrapolated(network, color, gbuffer, mask, history), frames[:, :3], (mask > 0).to(mask.dtype)
        else:
            output, trust = supersampled(network, frames), trusted(torch.ones_like(mask))
    value = (1 - young) * loss(output, truth, trust, STRUCTURE * structure(output, truth).mean())
    return value + young * squared(output, truth) if young else value


class Run:
    """A network in training, and the running mean of its tensors."""

    def __init__(self, name: str, settings: Settings, steps: int):
        self.name, self.settings, self.steps, self.step = name, settings, steps, 0
        self.network = make(name, settings.seed).to(torch.device("cpu"), memory_format=torch.channels_last)
        self.average = {key: tensor.detach().clone() for key, tensor in self.network.named_parameters()}
        self._optimisers = optimisers(self.network, nn.Module())

    def advance(self, batch: tuple[Tensor, ...]) -> float:
        """One step; returns the loss."""
        young, rate = infancy(self.step, self.steps), rate_at(self.step, self.steps, self.settings)
        for optimiser, factor in zip(self._optimisers, (1.0, ADAM), strict=True):
            optimiser.param_groups[0]["lr"] = rate * factor
        leak(self.network, LEAK * young)
        value = objective(self.name, self.network, batch, young, half=self.settings.half)
        value.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), CLIP)
        for optimiser in self._optimisers:
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        self.step += 1
        keep = min(AVERAGE, self.step / (self.step + 10))
        with torch.no_grad():
            for key, tensor in self.network.named_parameters():
                self.average[key].lerp_(tensor, 1 - keep)
        return float(value.detach())


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.rivals.train``."""
    parser = argparse.ArgumentParser(prog="python -m training.rivals.train", description=__doc__)
    parser.add_argument("data", type=Path, help="folder made by python -m training.rivals.samples")
    parser.add_argument("network", choices=tuple(NETWORKS))
    parser.add_argument("-o", "--out", type=Path, required=True, help="safetensors file")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--crop", type=int, default=64)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--rate", type=float, default=0.01)
    parser.add_argument("--warm-up", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--half", action="store_true", help="bfloat16")
    parser.add_argument("--threads", type=int, default=0, help="of the CPU; 0: PyTorch's choice")
    chosen = parser.parse_args(arguments)
    if chosen.threads:
        torch.set_num_threads(chosen.threads)
    settings = Settings(chosen.crop, chosen.batch, chosen.rate, chosen.warm_up, chosen.seed, chosen.half)
    drawn = batches(chosen.data, chosen.network, chosen.crop, chosen.batch, chosen.seed)
    run, total = Run(chosen.network, settings, chosen.steps), 0.0
    torch.set_flush_denormal(True)
    for step, batch in drawn.between(0, chosen.steps):
        total += run.advance(tensors(batch, torch.device("cpu")))
        if (step + 1) % 100 == 0 or step + 1 == chosen.steps:
            line = {"step": step + 1, "loss": round(total / (step % 100 + 1), 5), "minutes": round(time.process_time() / 60, 2)}
            sys.stdout.write(json.dumps(line) + "\n")
            sys.stdout.flush()
            total = 0.0
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    save_file({key: tensor.contiguous() for key, tensor in run.average.items()}, chosen.out, {"steps": str(chosen.steps)})


if __name__ == "__main__":
    command(main)
