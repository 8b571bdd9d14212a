# SPDX-License-Identifier: MIT
"""Run chains of the rivals over a sequence, beside STSS and methods without a network, and compare all with the truth.

Chains: `extranet+nsrr`, `nsrr+extranet` (the order swapped), and each alone: `extranet` (then bilinear), `nsrr` (EFs from the warped
frame). Each writes a folder of frames as `stss run` does. `stss compare` and `methods` judge them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
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
from stss.images.color import transfer
from stss.images.read_write import encode_rgb, read_rgb
from stss.images.resample import enlarged
from stss.run.options import RunOptions
from stss.sequence.reader import open_sequence
from stss.weights.file import load
from stss_ground.errors import InputError
from stss_lab.baselines.registry import METHODS, open_method
from stss_lab.methods.methods_table import print_results, run_methods, to_json
from stss_ref.arrays import Image, Mask
from stss_ref.frame import NetworkInputs, prepare
from stss_ref.resample import upsample_centres
from training.command import command
from training.rivals.networks import EARLIER, extrapolated, supersampled
from training.rivals.samples import five_frames
from training.rivals.train import make
from training.samples import number_files

CHAINS = ("extranet+nsrr", "nsrr+extranet", "extranet", "nsrr")


class Chain:
    """One of `CHAINS` as a `stss.frames.backends.Backend`."""

    name, accumulates, cost, activity = "pytorch", True, None, None

    def __init__(self, method: str, extranet: nn.Module, nsrr: nn.Module):
        self.method, self._extranet, self._nsrr = method, extranet, nsrr
        self._frames: dict[int, DisplayFrame] = {}
        self._rendered: dict[int, Image] = {}
        self._large: dict[int, DisplayFrame] = {}

    def expect(self, size: tuple[int, int]) -> None:
        """See `stss.frames.backends.Backend`: nothing needs to be prepared."""

    def compute(self, window: Sequence[DisplayFrame], steps: tuple[int, int, int]) -> tuple[Image, Mask]:
        """See `stss.frames.backends.Backend`; frames come in display order."""
        self._remember(window)
        now, rendered = window[-1], steps[0] == 0
        prepared = prepare(frame_inputs(window, steps))
        valid = prepared.mask.astype(bool)
        if self.method == "nsrr+extranet":
            for frame in window:
                if frame.number not in self._large:  # those before the first of a run too
                    large = None if frame.color is None else self._supersample(frame.number, frame.color, rendered=True)
                    self._large[frame.number] = enlarge_frame(frame, large)
            image = self._large[now.number].color
            if image is None:
                image = self._extrapolate(prepare(frame_inputs([self._large[f.number] for f in window], steps)))
            return image, valid
        small = prepared.color[..., :3]
        if not rendered and self.method != "nsrr":
            small = self._extrapolate(prepared)
        if self.method == "extranet":
            return upsample_centres(small), valid
        return self._supersample(now.number, small, rendered=rendered), valid

    def _remember(self, window: Sequence[DisplayFrame]) -> None:
        newest, oldest = window[-1].number, window[-1].number - 2 * EARLIER
        if newest - 1 not in self._frames:
            self._frames, self._rendered, self._large = {}, {}, {}
        for frame in window:
            if frame.number not in self._frames:
                self._frames[frame.number] = frame
                if frame.color is not None:
                    self._rendered[frame.number] = frame.color
        for kept in (self._frames, self._rendered, self._large):
            for number in [n for n in kept if n < oldest]:
                del kept[number]

    def _supersample(self, number: int, small: Image, *, rendered: bool) -> Image:
        planes = five_frames(self._frames, {**self._rendered, number: small}, number, rendered=rendered)
        return _run(partial(supersampled, self._nsrr), planes)

    def _extrapolate(self, prepared: NetworkInputs) -> Image:
        planes = [prepared.color, prepared.gbuffer, prepared.mask[..., None], *prepared.history]

        def run(x: torch.Tensor) -> torch.Tensor:
            return extrapolated(self._extranet, x[:, :6], x[:, 6:15], x[:, 15:16], x[:, 16:].unflatten(1, (3, 4)))

        return _run(run, np.concatenate(planes, axis=-1, dtype=np.float32))


def _run(model: Callable[[torch.Tensor], torch.Tensor], planes: Image) -> Image:
    height, width, _ = planes.shape
    padded = np.pad(planes, ((0, -height % 8), (0, -width % 8), (0, 0)), mode="edge")
    with torch.no_grad():
        made = model(torch.from_numpy(np.moveaxis(padded, -1, 0)[None].copy()))[0].numpy()
    scale = made.shape[1] // padded.shape[0]
    return np.ascontiguousarray(np.moveaxis(np.clip(made, 0, 1), 0, -1)[: scale * height, : scale * width])


def enlarge_frame(frame: DisplayFrame, color: Image | None) -> DisplayFrame:
    """The frame at twice the size, its pixels repeated, its positions between them; ``color`` (2H, 2W, 3) takes the colour's place."""
    planes = {name: enlarged(getattr(frame, name)) for name in ("gbuffer", "nov", "stencil")}
    return replace(frame, color=color, motion=enlarged(2 * frame.motion), position=upsample_centres(frame.position), **planes)


def write_png(folder: Path, out: Path, curve: str) -> None:
    """Write the EXR frames of a folder as PNG into another, as a screen shows them; ``curve``: of `stss.images.color.transfer`."""
    out.mkdir(parents=True, exist_ok=True)
    for number, path in number_files(folder).items():
        target = out / f"frame.{number:04d}.png"
        shown = transfer(curve).encode(read_rgb(path))
        target.write_bytes(encode_rgb(target, np.clip(shown, 0, 1), metadata={}))


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.rivals.run``."""
    parser = argparse.ArgumentParser(prog="python -m training.rivals.run", description=__doc__)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for one folder of frames of each method")
    parser.add_argument("--extranet", type=Path, required=True, help="weights of python -m training.rivals.train")
    parser.add_argument("--nsrr", type=Path, required=True)
    parser.add_argument("--weights", default="bilinear", help="STSS weights, for the method network")
    parser.add_argument("--methods", default=",".join((*CHAINS, "bilinear", "taau", NETWORK)))
    parser.add_argument("--profile")
    parser.add_argument("--camera", type=Path)
    parser.add_argument("--rendered", choices=("even", "odd", "all"))
    parser.add_argument("--frames", help="first:last")
    parser.add_argument("--flip", action="store_true")
    parser.add_argument("--vmaf", action="store_true")
    parser.add_argument("--json", type=Path, help="file for all scores of all frames")
    parser.add_argument("--png", type=Path, help="folder for all frames and the truth as PNG, for other metrics")
    chosen = parser.parse_args(arguments)
    names = chosen.methods.split(",")
    if unknown := [n for n in names if n not in (*CHAINS, *METHODS, NETWORK)]:
        raise InputError(f"--methods: expected some of {', '.join((*CHAINS, *METHODS, NETWORK))}; got {unknown[0]}")
    networks: dict[str, nn.Module] = {}
    for name in ("extranet", "nsrr"):
        networks[name] = make(name)
        networks[name].load_state_dict(load_file(getattr(chosen, name)))
    files, loaded = open_sequence(chosen.sequence, chosen.profile, camera=chosen.camera), load(chosen.weights)

    def engine(method: str) -> tuple[Backend, str]:
        if method in CHAINS:
            return cast(Backend, Chain(method, networks["extranet"], networks["nsrr"])), f"{chosen.extranet}, {chosen.nsrr}"
        return open_method(method, loaded)

    first_last = tuple(int(n) for n in chosen.frames.split(":")) if chosen.frames else None
    options = RunOptions.of(
        files.profile, transfer=None, depth=None, frames=cast("tuple[int, int] | None", first_last), rendered=chosen.rendered
    )
    results = run_methods(files, chosen.truth, chosen.out, names, engine, options, flip=chosen.flip, vmaf=chosen.vmaf)
    print_results(results, Console(width=200))
    if chosen.json:
        chosen.json.write_text(to_json(results))
    if chosen.png:
        for name in names:
            write_png(chosen.out / name, chosen.png / name, options.transfer)
        write_png(chosen.truth, chosen.png / "truth", options.transfer)


if __name__ == "__main__":
    command(main)
