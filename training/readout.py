# SPDX-License-Identifier: MIT
"""Solve the last layer anew: with all others held, the picture is linear in it, so the best one is the solution of a linear system.

It takes a minute where training takes hours, and it cannot forget: every sample of the training split counts, each by its own error,
so that dark clips count as much as bright ones. Flicker between consecutive frames is linear in the layer, too.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from stss.weights.file import load, save
from stss_ground.errors import InputError
from stss_ground.output.apart import require_places
from stss_ref.weights import Weights
from training.command import command
from training.data import Shard, StoredSample, load_shards, pairs, sets, whole
from training.loss import led_along
from training.network import Network, base, load_weights
from training.validate import tensors

Matrix = NDArray[np.float64]
NEAR = 0.002
"""How much the old layer draws, as a share of each weight's own curvature."""
LEAST = 2 / 255
"""Flicker below this counts by its square, else by its size."""


@dataclass(frozen=True)
class Seen:
    """What the last layer sees of a frame, and should make of it.

    ``layer`` (F, H, W): its inputs, and a constant 1 for its bias. ``target`` (3, 2H, 2W): the residual. ``motion`` (1, 2, H, W).
    """

    layer: Tensor
    target: Tensor
    motion: Tensor

    def spread(self) -> Tensor:
        """The layer at display size (4 F, 2H, 2W).

        Each of four pixels has weights of its own, so each feature is there four times, each time 0 but at one of the four.
        """
        made = torch.zeros(4, len(self.layer), *self.target.shape[1:])
        for i in range(4):
            made[i, :, i // 2 :: 2, i % 2 :: 2] = self.layer
        return made.flatten(0, 1)


def look(network: Network, place: StoredSample) -> Seen:
    """What the last layer sees of a sample."""
    seen: list[Tensor] = []
    color, gbuffer, mask, history, truth, motion = tensors(whole(place), torch.device("cpu"))
    hook = network.outc.register_forward_hook(lambda _module, inputs, _output: seen.append(inputs[0][0]))
    with torch.no_grad():
        network.residual(color, gbuffer, mask, history)
    hook.remove()
    height, width = (n // 2 for n in truth.shape[-2:])
    layer = torch.cat([seen[0], torch.ones_like(seen[0][:1])])[:, :height, :width]
    return Seen(layer, (truth - base(color)[..., : 2 * height, : 2 * width])[0], motion[..., :height, :width])


def gather(
    network: Network, old: Matrix, shards: list[Shard], extrapolated: float, steady: float, hold: float
) -> tuple[Matrix, Matrix]:
    """The system ``A x = b``, (P, P) and (P, 3), of the training split: every folder counts alike, and in it every sample."""
    size, before, folders = len(old), torch.from_numpy(old).float(), sets(pairs(shards, "training"))
    a, b = np.zeros((size, size)), np.zeros((size, 3))
    moving = sum(_consecutive(pair) for chosen in folders for pair in chosen)
    for chosen in folders:
        for pair in chosen:
            seen = [look(network, place) for place in pair]
            for one, share in zip(seen, (1 - extrapolated, extrapolated), strict=True):
                x, y = one.layer.flatten(1), nn.functional.pixel_unshuffle(one.target, 2).unflatten(0, (3, 4)).flatten(2)
                made = before.T.reshape(3, 4, -1) @ x
                scaled = share / (len(folders) * len(chosen) * float((made - y).square().mean()) * x.shape[1]) * x.double()
                y = torch.lerp(y, made, hold)
                a += np.kron(np.eye(4), (scaled @ x.double().T).numpy())
                b += np.concatenate([(scaled @ y[:, i].double().T).numpy() for i in range(4)])
            if steady and _consecutive(pair):
                early, late = (one for _, one in sorted(zip(pair, seen, strict=True), key=lambda both: _number(both[0])))
                led, followed = led_along(torch.cat([early.spread(), early.target])[None], late.motion)
                change = (torch.cat([late.spread(), late.target]) - led[0])[:, followed[0] > 0]
                x, y = change[:size], change[size:]
                off = (before.T @ x - y).abs()
                scaled = x / off.mean(0).clamp(min=LEAST) * (steady / (moving * float(off.mean()) * x.shape[1]))
                a += (scaled @ x.T).numpy()
                b += (scaled @ y.T).numpy()
    return a, b


def _consecutive(pair: tuple[StoredSample, ...]) -> bool:
    return _number(pair[0]) != _number(pair[1])


def _number(place: StoredSample) -> int:
    return place.shard.frames[place.index]


def solve(weights: Weights, shards: list[Shard], extrapolated: float = 0.5, steady: float = 0.0, hold: float = 0.0) -> Weights:
    """The weights with another last layer.

    Args:
        weights: what is improved.
        shards: their training split is what counts.
        extrapolated: the share of EFs.
        steady: how much flicker's error counts beside the squared error, each divided by what it is now.
        hold: how far from the truth to the old picture the squared error's aim is; 1 keeps what data that are not there taught.
    """
    network = Network()
    load_weights(network, weights)
    network.eval()
    outc, bias = network.outc, network.outc.bias
    assert bias is not None
    # (12, F): a row for each of three colours and, in it, four pixels -> (4 F, 3).
    rows = torch.cat([outc.weight[:, :, 0, 0], bias[:, None]], 1).detach().double().numpy()
    old = rows.reshape(3, -1).T
    a, b = gather(network, old, shards, extrapolated, steady, hold)
    pull = np.diag(NEAR * np.diag(a) + 1e-12)
    new = np.linalg.solve(a + pull, b + pull @ old).T.reshape(rows.shape).astype(np.float32)
    return weights | {"outc.weight": new[:, :-1, None, None].copy(), "outc.bias": new[:, -1].copy()}


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.readout``."""
    parser = argparse.ArgumentParser(prog="python -m training.readout", description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="folder of shards, made by python -m training.samples")
    parser.add_argument("--weights", required=True, help="safetensors file")
    parser.add_argument("--extrapolated", type=float, default=0.5, help="share of EFs in the squared error")
    parser.add_argument("--steady", type=float, default=0.0, metavar="F", help="how much flicker counts")
    parser.add_argument("--hold", type=float, default=0.0, metavar="F", help="share of the old picture in the aim, to 1")
    parser.add_argument("--threads", type=int, default=0, help="of the CPU; 0: PyTorch's choice")
    parser.add_argument("-o", "--out", type=Path, required=True)
    chosen = parser.parse_args(arguments)
    if chosen.threads:
        torch.set_num_threads(chosen.threads)
    for name, share in (("--extrapolated", chosen.extrapolated), ("--hold", chosen.hold)):
        if not 0 <= share <= 1:
            raise InputError(f"{name}: expected 0 to 1, found {share}")
    require_places({"--out": chosen.out}, [chosen.data, Path(chosen.weights)])
    loaded = load(chosen.weights)
    made = solve(loaded.weights, load_shards(chosen.data), chosen.extrapolated, chosen.steady, chosen.hold)
    settings = json.dumps({"extrapolated": chosen.extrapolated, "steady": chosen.steady, "hold": chosen.hold})
    save(chosen.out, made, {"readout": settings, "average_of": json.dumps([dict(loaded.metadata)])})


if __name__ == "__main__":
    command(main)
