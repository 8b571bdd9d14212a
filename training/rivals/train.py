# SPDX-License-Identifier: MIT
"""Train ExtraNet and NSRR as `training.train` trains STSS: its batches, augmentation, loss, optimisers, rates and running mean."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import cast

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from stss_ground.errors import InputError
from stss_ground.output.places import require_places
from training.augment import AUGMENTS, COLORS, DETAIL, MOTION, Augment, augment
from training.checkpoint import State
from training.command import command
from training.data import Batches, Kind, Shard, load_shards
from training.initial import hold_gates, initialise
from training.loss import STRUCTURE, loss, squared, structure, trusted
from training.network import Heads, Network, leak
from training.rivals.networks import EARLIER, NSRR, PLANES, ExtraNet
from training.step import LEAK, descend
from training.train import Settings, infancy, optimisers, rate_at
from training.validate import tensors

FRAMES = DETAIL.stop
"""The first of NSRR's channels in a shard."""
ALL_COLORS = (*COLORS, *(slice(FRAMES + 4 * i, FRAMES + 4 * i + 3) for i in range(EARLIER + 1)))
ALL_MOTIONS = (MOTION, *(slice(FRAMES + PLANES + 2 * i, FRAMES + PLANES + 2 * i + 2) for i in range(EARLIER)))
NETWORKS: dict[str, Callable[[], nn.Module]] = {"extranet": ExtraNet, "nsrr": NSRR}
KINDS: dict[str, tuple[Kind, ...]] = {"extranet": ("EF",), "nsrr": ("SF", "EF")}
"""The training data of each. NSRR's EFs have the frame itself as newest, for which ExtraNet's stands later."""


def make(name: str, seed: int = 0) -> nn.Module:
    """A network of `NETWORKS` with random weights, near the picture that it adds to."""
    network = NETWORKS[name]()
    initialise(network.to(memory_format=torch.channels_last), seed)
    if name == "extranet":
        hold_gates(cast(Network, network))
    return network


def read(name: str, path: Path) -> nn.Module:
    """A network of `NETWORKS` with the weights of a file; InputError for another file."""
    network = make(name)
    try:
        network.load_state_dict(load_file(path))
    except (OSError, SafetensorError, RuntimeError) as error:
        raise InputError(f"{path}: expected weights of python -m training.rivals.train DATA {name}") from error
    return network


def load_extended(data: Path) -> list[Shard]:
    """The shards of a folder of `training.rivals.samples`; InputError for other shards."""
    shards = load_shards(data)
    if shards[0].inputs.shape[-1] != FRAMES + PLANES + 2 * EARLIER:
        raise InputError(f"{data}: expected shards of python -m training.rivals.samples")
    return shards


def batches(data: Path, name: str, side: int, batch: int, seed: int, how: Augment = "all") -> Batches:
    """The batches of a network; ``data`` is a folder of `training.rivals.samples`, ``how`` as in `training.augment.augment`."""
    own = Batches(load_extended(data), side=side, batch=batch, seed=seed, kinds=KINDS[name], masking=False)
    own.augment = partial(augment, how=how, colors=ALL_COLORS, motions=ALL_MOTIONS)
    return own


def objective(name: str, network: nn.Module, batch: tuple[Tensor, ...], young: float, *, half: bool) -> Tensor:
    """The loss of a batch of `batches`, as `training.step.objective` takes it of STSS; ExtraNet aims at the rendered small frame."""
    color, gbuffer, mask, history, truth, further = batch
    frames = further[:, 2:]
    with torch.autocast(color.device.type, torch.bfloat16, enabled=half):
        if name == "extranet":
            output, truth, trust = network(color, gbuffer, mask, history), frames[:, :3], (mask > 0).to(mask.dtype)
        else:
            output, trust = network(frames), trusted(torch.ones_like(mask))
    value = (1 - young) * loss(output, truth, trust, STRUCTURE * structure(output, truth).mean())
    return value + young * squared(output, truth) if young else value


def start(network: nn.Module) -> State:
    """A network in training at step 0."""
    average = {key: tensor.detach().clone() for key, tensor in network.named_parameters()}
    return State(0, cast(Network, network), Heads(), average, optimisers(network, nn.Module()), 0, {})


def advance(name: str, state: State, batch: tuple[Tensor, ...], settings: Settings, steps: int) -> float:
    """One step of ``steps``; returns the loss."""
    young = infancy(state.step, steps)
    leak(state.network, LEAK * young)
    value = objective(name, state.network, batch, young, half=settings.half)
    return float(descend(state, value, rate_at(state.step, steps, settings)))


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.rivals.train``."""
    parser = argparse.ArgumentParser(prog="python -m training.rivals.train", description=__doc__)
    parser.add_argument("data", type=Path, help="folder made by python -m training.rivals.samples")
    parser.add_argument("network", choices=tuple(NETWORKS))
    parser.add_argument("-o", "--out", type=Path, required=True, help="safetensors file")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--warm-up", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--augment", choices=AUGMENTS, default="all", help="see python -m training.train")
    parser.add_argument("--half", action="store_true", help="bfloat16")
    options = parser.parse_args(arguments)
    require_places({"--out": options.out} if options.out.exists() else {}, options.data.rglob("*"))
    torch.set_num_threads(1)
    settings = Settings(64, options.batch, 0.01, options.warm_up, options.seed, options.half)
    data = batches(options.data, options.network, 64, options.batch, options.seed, options.augment)
    state = start(make(options.network, options.seed))
    torch.set_flush_denormal(True)
    for step, batch in data.between(0, options.steps):
        value = advance(options.network, state, tensors(batch, torch.device("cpu")), settings, options.steps)
        if (step + 1) % 100 == 0:
            sys.stdout.write(f"step {step + 1}: loss {value:.5f}, {time.process_time() / 60:.2f} minutes\n")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    save_file({key: tensor.contiguous() for key, tensor in state.average.items()}, options.out, {"steps": str(options.steps)})


if __name__ == "__main__":
    command(main)
