# SPDX-License-Identifier: MIT
"""Estimate the worth of a part of the input, or of more features, to trained weights, in a minute and without training.

The last layer is linear in the 24 features before it, so the best last layer for any features is a least-squares fit (Alain and
Bengio 2016, Understanding Intermediate Layers Using Linear Classifier Probes). The fit is made on the training split and scored on
another: with a part of the input blanked, with the history as further features, or with the features of other networks added.
``--as-is`` fits nothing: it only blanks, and needs no training split.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from stss.weights.file import load
from training.command import command
from training.data import KINDS, Shard, StoredSample, load_shards, places, spread, whole
from training.network import Network, load_weights
from training.validate import bilinear

BLANKED = {"normals": slice(0, 3), "depth": slice(3, 4), "roughness, metallic": slice(4, 6), "base colour": slice(6, 9)}
"""Channels of the G-buffer that are replaced by their mean over the frame."""
REFITTED, RIDGE = "last layer refitted", 1e-8
STEP = 4
"""The fit takes every fourth pixel of a training frame."""


class Probe:
    """A network, with others beside it: it gives the features that the last layer of each variant reads."""

    def __init__(self, weights: str, beside: Sequence[str] = ()):
        self.networks = [_network(name) for name in (weights, *beside)]
        self.without_erm = _network(weights, "erm")

    def variants(self, place: StoredSample) -> tuple[Tensor, dict[str, Tensor]]:
        """The truth minus bilinear, (N, 12) for N pixels, and the features (N, F) of each variant, the last of which is 1."""
        color, gbuffer, mask, history, truth = (torch.from_numpy(array) for array in whole(place)[:5])
        (main, *others), batch = self.networks, (color, gbuffer, mask, history)
        with torch.no_grad():
            features = _features(main, *batch)
            found = {REFITTED: features}
            for name, part in BLANKED.items():
                found[f"without {name}"] = _features(main, color, _blank(gbuffer, part), mask, history)
            found["without G-buffer"] = _features(main, color, torch.zeros_like(gbuffer), mask, history)
            found["without mask"] = _features(main, color, gbuffer, torch.ones_like(mask), history)
            if main.second_color == "earlier":
                found["without earlier colour"] = _features(main, color, gbuffer, mask, torch.zeros_like(history))
            found["without ERM"] = _features(self.without_erm, *batch)
            low, full = history_features(color, history)
            modulated = (features[:, :, None] * low[:, None]).flatten(1, 2)
            found["with the history at an eighth"] = torch.cat([features, low, modulated], 1)
            found["with the history at full size"] = torch.cat([features, full], 1)
            if others:
                found[f"with the features of {len(others)} more"] = torch.cat(
                    [features, *(_features(n, *batch) for n in others)], 1
                )
        height, width = place.shard.inputs.shape[1:3]
        base = bilinear(*batch)[..., : 2 * height, : 2 * width]
        lacking = nn.functional.pixel_unshuffle(truth - base, 2)
        return _rows(lacking), {name: _rows(_with_one(f[..., :height, :width])) for name, f in found.items()}

    def shipped(self) -> Tensor:
        """The network's own last layer (25, 12)."""
        layer = self.networks[0].outc
        assert layer.bias is not None
        return torch.cat([layer.weight.detach()[:, :, 0, 0].T, layer.bias.detach()[None]])


def _network(weights: str, without: str = "") -> Network:
    made = Network(without)
    load_weights(made, load(weights).weights)
    return made.eval()


def _features(network: Network, *batch: Tensor) -> Tensor:
    """The features that the last layer reads, (1, 24, H, W)."""
    kept: list[Tensor] = []
    hook = network.outc.register_forward_pre_hook(lambda _, inputs: kept.append(inputs[0]))
    network(*batch)
    hook.remove()
    return kept[0]


def _blank(gbuffer: Tensor, part: slice) -> Tensor:
    blanked = gbuffer.clone()
    blanked[:, part] = gbuffer[:, part].mean((2, 3), keepdim=True)
    return blanked


def history_features(color: Tensor, history: Tensor) -> tuple[Tensor, Tensor]:
    """Differences of the two older warped frames from the newest, where their masks are 1.

    Returns:
        low: (1, 10, H, W) means over 8 x 8 pixels, the size of the history's features, enlarged again.
        full: (1, 54, H, W) differences of the 3 x 3 pixels around each.
    """
    low, full = [], []
    for older in (history[:, 0], history[:, 1]):
        trusted = older[:, 3:]
        difference = (older[:, :3] - color[:, :3]) * trusted
        coarse = [difference, difference.square().mean(1, keepdim=True), trusted]
        low.append(nn.functional.avg_pool2d(torch.cat(coarse, 1), 8))
        full.append(nn.functional.unfold(difference, 3, padding=1).unflatten(2, difference.shape[2:]))
    return nn.functional.interpolate(torch.cat(low, 1), scale_factor=8, mode="bilinear", align_corners=True), torch.cat(full, 1)


def _with_one(features: Tensor) -> Tensor:
    return torch.cat([features, torch.ones_like(features[:, :1])], 1)


def _rows(planes: Tensor) -> Tensor:
    return planes[0].flatten(1).T


def fit(made: Iterator[tuple[Tensor, dict[str, Tensor]]]) -> dict[str, Tensor]:
    """The last layer (F, 12) with the least squared error, for each variant."""
    squares: dict[str, Tensor] = {}
    products: dict[str, Tensor] = {}
    for lacking, variants in made:
        y = lacking[::STEP].double()
        for name, features in variants.items():
            x = features[::STEP].double()
            squares[name] = squares.get(name, 0) + x.T @ x
            products[name] = products.get(name, 0) + x.T @ y
    return {name: _solve(squares[name], products[name]).float() for name in squares}


def _solve(squares: Tensor, products: Tensor) -> Tensor:
    ridge = RIDGE * squares.diag().mean() * torch.eye(len(squares), dtype=squares.dtype)
    return torch.linalg.solve(squares + ridge, products)


def scores(probe: Probe, shards: list[Shard], split: str, kind: str, most: int, *, as_is: bool = False) -> dict[str, float]:
    """Mean PSNR over RGB, dB, of bilinear, of the weights as they are, and of each variant.

    The last layer is fitted on the training split. ``as_is``: it is the weights' own, and only parts of the input are blanked.
    """
    fitted = () if as_is else spread(places(shards, "training", kind), most)
    layers = fit(probe.variants(place) for place in fitted)
    errors: dict[str, list[Tensor]] = {}
    for place in spread(places(shards, split, kind), most):
        lacking, variants = probe.variants(place)
        made = {"bilinear": torch.zeros_like(lacking), "as they are": variants[REFITTED] @ probe.shipped()}
        if as_is:
            layers = dict.fromkeys((name for name in variants if name.startswith("without ")), probe.shipped())
        made |= {name: variants[name] @ layer for name, layer in layers.items()}
        for name, residual in made.items():
            errors.setdefault(name, []).append((residual - lacking).square().mean())
    return {name: float((-10 * torch.stack(found).log10()).mean()) for name, found in errors.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.probe``."""
    parser = argparse.ArgumentParser(prog="python -m training.probe", description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="folder of shards")
    parser.add_argument("--weights", default="realtime", help="safetensors file")
    parser.add_argument("--beside", nargs="+", default=[], metavar="WEIGHTS", help="networks whose features are added")
    parser.add_argument("--split", default="validation", choices=("training", "validation", "test"))
    parser.add_argument("--as-is", action="store_true", help="the weights' own last layer, fitted to nothing")
    parser.add_argument("--most", type=int, default=32, help="frames of each kind")
    chosen = parser.parse_args(arguments)
    probe, shards = Probe(chosen.weights, chosen.beside), load_shards(chosen.data)
    found = [scores(probe, shards, chosen.split, kind, chosen.most, as_is=chosen.as_is) for kind in KINDS]
    lines = [f"| {name} | " + " | ".join(f"{one[name]:.2f}" for one in found) + " |" for name in found[0]]
    sys.stdout.write("\n".join([f"| | {' | '.join(KINDS)} |", "|---|---|---|", *lines]) + "\n")


if __name__ == "__main__":
    command(main)
