# SPDX-License-Identifier: MIT
"""Start the deep half of trained weights anew where it died, so that a further run can use it.

Long runs that start from weights have no aids against dying ReLUs (decision 17), and their decay wears down what the image does not
need at once. In the weights of 2026-11-22 every unit of the ERM's second layer and 50 of 64 of ``up1`` are 0 everywhere, so nothing
deeper than half the size reaches the image. Here these layers are drawn anew. Their constant part of the image goes into the bias of
``up2``, so the image hardly changes. ``--aids`` of `training.train` then keeps them alive. ``--units`` leaves these layers as they
are, and draws anew the dead units of the layers at full and half size.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from stss.weights.file import load, save
from training.command import command
from training.data import KINDS, Shard, load_shards, places, spread, whole
from training.initial import initialise
from training.network import Gated, Network, Rectifier, load_weights, to_weights

ANEW = ("down3.", "latentEncoder.", "KEncoder.", "convHis", "lowlevelGated.", "up1.")
"""Layers that are drawn anew."""
READ = 0.3
"""Size of the kernels by which ``up2`` reads them, relative to those by which it reads the skip."""
HEARD = 0.15
"""Size of the kernels that read a unit drawn anew, relative to those of their layer."""
SKIP = 24
"""Channels of ``up2``'s input that are the skip; the others are ``up1``'s."""


def share_of_dead(network: Network, shards: list[Shard], split: str = "training", most: int = 4) -> dict[str, float]:
    """The share of units of each layer of the decoder and the ERM that are 0 everywhere in some frames."""
    alive: dict[str, Tensor] = {}

    def look(name: str):
        def hook(_: nn.Module, __: tuple[Tensor, ...], output: Tensor) -> None:
            found = (output > 0).flatten(2).any(2).any(0)
            alive[name] = found | alive[name] if name in alive else found

        return hook

    chains = ("latentEncoder", "KEncoder", "up1", "up2", "up3")
    hooks = [
        module.register_forward_hook(look(name))
        for name, module in network.named_modules()
        if isinstance(module, Rectifier) and name.startswith(chains)
    ]
    for kind in KINDS:
        for place in spread(places(shards, split, kind), most):
            with torch.no_grad():
                network(*(torch.from_numpy(array) for array in whole(place)[:4]))
    for hook in hooks:
        hook.remove()
    return {name: 1 - float(found.float().mean()) for name, found in alive.items()}


def revive(network: Network, shards: list[Shard], seed: int = 0, most: int = 8) -> None:
    """Draw the deep layers of ``network`` anew, in place; the mean of ``most`` training frames of each kind gives their constant part."""
    means: list[Tensor] = []
    hook = network.up2.register_forward_pre_hook(lambda _, given: means.append(given[1].mean((0, 2, 3))))
    for kind in KINDS:
        for place in spread(places(shards, "training", kind), most):
            with torch.no_grad():
                network(*(torch.from_numpy(array) for array in whole(place)[:4]))
    hook.remove()
    first = network.up2.conv.double_conv[0]
    assert isinstance(first, nn.Conv2d)
    assert first.bias is not None
    fresh = Network()
    initialise(fresh, seed)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        first.bias += first.weight[:, SKIP:].sum((2, 3)) @ torch.stack(means).mean(0)
        size = READ * first.weight[:, :SKIP].square().mean().sqrt()
        first.weight[:, SKIP:] = size * torch.randn(first.weight[:, SKIP:].shape, generator=generator)
        drawn = dict(fresh.named_parameters())
        for name, tensor in network.named_parameters():
            if name.startswith(ANEW):
                tensor.copy_(drawn[name])


def revive_units(network: Network, shards: list[Shard], seed: int = 0, most: int = 16) -> int:
    """Draw the dead units of ``conv1``, ``conv2``, ``up2`` and ``up3`` anew, in place; returns how many were 0 in all frames."""
    up2, up3 = (cast("list[nn.Conv2d]", list(up.conv.double_conv)) for up in (network.up2, network.up3))
    readers: dict[nn.Module, list[tuple[nn.Conv2d, int]]] = {
        network.conv1: [(conv, 0) for conv in _convolutions(network.conv2)],
        network.conv2: [*((conv, 0) for conv in _convolutions(network.down1.downsample)), (up3[0], 0)],
        up2[0]: [(up2[2], 0)],
        up2[2]: [(up3[0], SKIP)],
        up3[0]: [(up3[2], 0)],
        up3[2]: [(network.outc, 0)],
    }
    alive: dict[nn.Module, Tensor] = {}

    def look(module: nn.Module, _: tuple[Tensor, ...], output: Tensor) -> None:
        found = (output > 0).flatten(2).any(2).any(0)
        alive[module] = found | alive[module] if module in alive else found

    hooks = [module.register_forward_hook(look) for module in readers]
    for kind in KINDS:
        for place in spread(places(shards, "training", kind), most):
            with torch.no_grad():
                network(*(torch.from_numpy(array) for array in whole(place)[:4]))
    for hook in hooks:
        hook.remove()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for module, read_by in readers.items():
            made = _convolutions(module)[0]
            for unit in (~alive[module]).nonzero().flatten().tolist():
                _draw(made.weight[unit], made.weight[alive[module]], 1.0, generator)
                cast(Tensor, made.bias)[unit] = 0
                for conv, first in read_by:
                    _draw(conv.weight[:, first + unit], conv.weight, HEARD, generator)
    return sum(int((~found).sum()) for found in alive.values())


def _convolutions(module: nn.Module) -> list[nn.Conv2d]:
    return [module.conv_feature, cast(nn.Conv2d, module.conv_mask[0])] if isinstance(module, Gated) else [cast(nn.Conv2d, module)]


def _draw(kernels: Tensor, like: Tensor, size: float, generator: torch.Generator) -> None:
    """Fill with noise that is ``size`` times as large as ``like``."""
    kernels.copy_(size * like.square().mean().sqrt() * torch.randn(kernels.shape, generator=generator))


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.revive``."""
    parser = argparse.ArgumentParser(prog="python -m training.revive", description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="folder of shards")
    parser.add_argument("--weights", required=True, help="safetensors file")
    parser.add_argument("--units", action="store_true", help="the dead units of the other layers, and not the deep ones")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", type=Path, help="safetensors file to write; without it, only the shares of dead units")
    chosen = parser.parse_args(arguments)
    shards, network = load_shards(chosen.data), Network()
    load_weights(network, load(chosen.weights).weights)
    for name, share in share_of_dead(network, shards).items():
        sys.stdout.write(f"{name}: {share:.2f} dead\n")
    if chosen.out:
        (revive_units if chosen.units else revive)(network, shards, chosen.seed)
        save(chosen.out, to_weights(network.state_dict(), network.second_color), {"revived": chosen.weights})


if __name__ == "__main__":
    command(main)
