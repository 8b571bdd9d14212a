# SPDX-License-Identifier: MIT
"""Train the network: Muon and Adam, warm-up and cosine, a running mean of the weights, checkpoints, a log."""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path

import torch
from torch import nn

from stss.weights.file import ALIASED, MADE_FOR, LoadedWeights, load, save
from stss_ground.errors import InputError
from stss_ground.output.places import require_places
from stss_ref.constants import HoleFill
from stss_ref.weights import SECOND_COLORS, SecondColor
from training import checkpoint
from training.augment import AUGMENTS, Augment
from training.checkpoint import State
from training.command import command
from training.data import Batches, Shard, load_shards
from training.initial import forget_second_color, hold_gates, hold_history, initialise
from training.loss import STRUCTURE
from training.muon import Muon
from training.network import Heads, Network, load_weights, to_weights
from training.step import Aims, advance
from training.validate import Means, bilinear, evaluating, tensors, validate


@dataclass(frozen=True)
class Settings:
    """The settings that change the numbers of a run; a resumed run may have more steps.

    ``data``: a digest of the shards' names and splits: the best score so far is that of their validation frames.
    ``young``: the factor of `infancy`. ``squares``: the share of the squared error in the loss that stays after it.
    ``history``: whether the history is used.
    ``structure``, ``structure_ef``: the perceptual distance over 1 - SSIM, in SFs and in EFs.
    ``extrapolated``: the share of EFs in the squared error.
    ``masking``: Random Reshading Masking. ``holes``: how often errors in reshading regions count in the squared error.
    ``augment``: see `training.augment.augment`.
    ``compiled``: whether a step is compiled, which changes its rounding.
    ``second_color``, ``hole_fill``: see `stss_ref.frame.prepare`; the samples have the latter.
    ``steady``: see `training.step.Aims`.
    ``aliased``: whether the run starts from weights whose file says that they are made for aliased frames; its own then say so, too.
    """

    crop: int
    batch: int
    rate: float
    warm_up: int
    seed: int
    half: bool
    young: float = 1.0
    squares: float = 0.0
    history: bool = True
    structure: float = STRUCTURE
    structure_ef: float = STRUCTURE
    extrapolated: float = 0.5
    masking: bool = True
    holes: float = 1.0
    augment: Augment = "all"
    compiled: bool = False
    second_color: SecondColor = "newest"
    hole_fill: HoleFill = "occlusion_warp"
    steady: float = 0.0
    aliased: bool = False
    data: str = ""


@dataclass(frozen=True)
class Plan:
    """Length of a run, and intervals of its output.

    Attributes:
        steps: number of steps at the end of the run.
        validate: steps between two validations, each of which writes scores, weights and a checkpoint.
        log: steps between two records of the loss.
        most: most validation frames of each kind.
    """

    steps: int
    validate: int
    log: int
    most: int


def rate_at(step: int, steps: int, settings: Settings) -> float:
    """Learning rate: linear up over ``warm_up`` steps, then half a cosine down to a hundredth."""
    if step < settings.warm_up:
        return settings.rate * (step + 1) / settings.warm_up
    share = (step - settings.warm_up) / max(1, steps - settings.warm_up)
    return settings.rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(share, 1.0))))


def infancy(step: int, steps: int, share: float = 0.5) -> float:
    """Falls linearly from 1 at the start to 0 at ``share`` of the run: leaky ReLUs, the squared error, and the heads."""
    return max(0.0, 1 - step / (share * steps))


def start(settings: Settings, device: torch.device, initial: str | None = None) -> State:
    """A run at step 0; ``initial`` names weights to start from."""
    network, heads = Network("" if settings.history else "history"), Heads()
    initialise(heads, settings.seed)
    if initial is None:
        initialise(network, settings.seed)
    else:
        load_weights(network, load(initial).weights)
        if network.second_color != settings.second_color:
            forget_second_color(network)
    network.second_color = settings.second_color
    if network.without != "deep":
        hold_gates(network)
    if not settings.history:
        hold_history(network)
    heads.to(device)
    network.to(device).to(memory_format=torch.channels_last)
    average = {name: t.detach().clone() for name, t in network.named_parameters()}
    return State(0, network, heads, average, optimisers(network, heads), -math.inf, asdict(settings))


def optimisers(network: nn.Module, heads: nn.Module) -> tuple[torch.optim.Optimizer, ...]:
    """Muon for kernels of 3 x 3; Adam for gates and biases, which are vectors, and for the last layer, which only reads features out."""
    parameters = {name: p for name, p in network.named_parameters() if p.requires_grad}
    kernels = [p for name, p in parameters.items() if p.ndim == 4 and not name.startswith("outc") and ".conv_mask." not in name]
    others = [p for p in parameters.values() if all(p is not kernel for kernel in kernels)] + list(heads.parameters())
    return Muon(kernels, 1.0), torch.optim.Adam(others, 1.0, betas=(0.9, 0.999), eps=1e-7, fused=True)


class Log:
    """Write ``log.jsonl`` of a run, one line a record, and print each record."""

    def __init__(self, folder: Path):
        self.path = folder / "log.jsonl"

    def __call__(self, **record: object) -> None:
        """Append a record."""
        line = json.dumps(record)
        with self.path.open("a") as file:
            file.write(line + "\n")
        sys.stdout.write(line + "\n")
        sys.stdout.flush()

    def cut(self, step: int) -> None:
        """Drop records after ``step``: those of a run that was killed after its last checkpoint."""
        if self.path.exists():
            lines = [line for line in self.path.read_text().splitlines() if json.loads(line)["step"] <= step]
            self.path.write_text("".join(line + "\n" for line in lines))


FILES = ("weights.safetensors", "best.safetensors", "state.safetensors")


def keep(out: Path, state: State, means: Means) -> None:
    """Write ``weights.safetensors``, also as ``best.safetensors`` if its score is the best, and last the checkpoint.

    Of step 0 only the best: those that the run starts from, until a step is better.
    """
    weights, metadata = (
        to_weights(state.average, state.settings["second_color"], state.settings["hole_fill"]),
        {"steps": str(state.step), "validation": json.dumps(means)},
    )
    metadata["settings"] = json.dumps(state.settings)
    if state.settings["aliased"]:
        metadata[MADE_FOR] = ALIASED
    if state.step:
        save(out / "weights.safetensors", weights, metadata)
    mean = (means["SF"] + means["EF"]) / 2
    if mean > state.best:
        state.best = mean
        save(out / "best.safetensors", weights, metadata)
    if state.step:
        checkpoint.write(out / "state.safetensors", state)


def train(out: Path, shards: list[Shard], state: State, settings: Settings, plan: Plan, device: torch.device) -> None:
    """Train from ``state`` up to ``plan.steps``; training/README.md lists the files in ``out``."""
    log = Log(out)
    log.cut(state.step)
    if state.step == 0:
        before = {"bilinear": bilinear, "initial": evaluating(state.average, state.network)}
        scores = {name: validate(model, shards, "validation", most=plan.most, device=device) for name, model in before.items()}
        log(step=0, **scores)
        keep(out, state, scores["initial"])
    batches = Batches(
        shards,
        side=settings.crop,
        batch=settings.batch,
        seed=settings.seed,
        masking=settings.masking,
        how=settings.augment,
    )
    aims = Aims(
        half=settings.half,
        squares=settings.squares,
        similar=(settings.structure, settings.structure_ef),
        extrapolated=settings.extrapolated,
        holes=settings.holes,
        steady=settings.steady,
    )
    total, count, since = torch.zeros((), device=device), 0, time.perf_counter()
    for step, batch in batches.between(state.step, plan.steps):
        rate = rate_at(step, plan.steps, settings)
        now = replace(aims, young=settings.young * infancy(step, plan.steps))
        total += advance(state, tensors(batch, device), rate, now, compiled=settings.compiled)
        count += 1
        if state.step % plan.log == 0:
            value, clock = float(total) / count, time.perf_counter()
            log(step=state.step, loss=round(value, 6), rate=rate, ms=round((clock - since) / count * 1e3, 1))
            if not math.isfinite(value):
                raise InputError(f"step {state.step}: the loss is {value}; resume with a smaller --rate in another run")
            total, count, since = torch.zeros((), device=device), 0, clock
        if state.step % plan.validate == 0 or state.step == plan.steps:
            means = validate(evaluating(state.average, state.network), shards, "validation", most=plan.most, device=device)
            log(step=state.step, validation=means)
            keep(out, state, means)
            since = time.perf_counter()


def device_of(name: str) -> torch.device:
    """PyTorch's device.

    Raises:
        InputError: there is none of this name here.
    """
    try:
        device = torch.device(name)
        torch.zeros((), device=device)
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"--device {name}: {str(error).splitlines()[0]}") from error
    return device


def digest_of(shards: Sequence[Shard]) -> str:
    """The number of shards, and a digest of their names and splits."""
    names = "\n".join(f"{shard.name} {shard.split}" for shard in shards)
    return f"{len(shards)} shards, {sha256(names.encode()).hexdigest()[:8]}"


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m training.train", description=__doc__)
    parser.add_argument("data", type=Path, help="folder of shards, made by python -m training.samples")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder of the run")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--crop", type=int, default=64, help="side of a crop in pixels of the low resolution")
    parser.add_argument("--batch", type=int, default=8, help="crops in a step: half SF, half EF")
    parser.add_argument("--rate", type=float, default=0.01, help="learning rate after the warm-up")
    parser.add_argument("--warm-up", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--initial", help="start from a safetensors file, realtime or antialiased; default: near bilinear, the rest random"
    )
    parser.add_argument("--squares", type=float, default=0.0, help="share of the squared error in the loss; raises PSNR")
    parser.add_argument("--structure", type=float, default=STRUCTURE, help="factor of 1 - SSIM, the perceptual distance")
    parser.add_argument("--structure-ef", type=float, metavar="F", help="the same for EFs, if it differs")
    parser.add_argument("--extrapolated", type=float, default=0.5, help="share of EFs in the squared error")
    parser.add_argument("--holes", type=float, default=1.0, help="factor of reshading regions in the squared error")
    parser.add_argument("--steady", type=float, default=0.0, metavar="F", help="factor of flicker, beside the other errors")
    parser.add_argument("--no-masking", dest="masking", action="store_false", help="without Random Reshading Masking")
    parser.add_argument("--no-history", dest="history", action="store_false", help="weights that do not read the history")
    parser.add_argument(
        "--augment",
        choices=AUGMENTS,
        default="all",
        help="upright: crops are neither turned nor their colours exchanged; none: for one scene",
    )
    parser.add_argument(
        "--second-color",
        choices=SECOND_COLORS,
        help="content of the network's second colour; default: as in --initial, or newest",
    )
    parser.add_argument("--compile", action="store_true", help="compile a step: a third faster, needs a C++ compiler")
    parser.add_argument("--validate", type=int, default=1000, metavar="STEPS")
    parser.add_argument("--log", type=int, default=100, metavar="STEPS")
    parser.add_argument("--most", type=int, default=32, help="validation frames of each kind")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--half", choices=("auto", "on", "off"), default="auto", help="bfloat16; auto: on GPUs")
    parser.add_argument("--threads", type=int, default=0, help="threads of the CPU; 0: PyTorch's choice")
    parser.add_argument("--resume", action="store_true", help="continue from the run's checkpoint, if there is one")
    return parser.parse_args(arguments)


def settings_of(
    args: argparse.Namespace, initial: LoadedWeights | None, shards: Sequence[Shard], device: torch.device
) -> Settings:
    """The run's settings: those of the command line, of the initial weights and of the shards."""
    half = args.half == "on" or (args.half == "auto" and device.type == "cuda")
    return Settings(
        crop=args.crop,
        batch=args.batch,
        rate=args.rate,
        warm_up=args.warm_up,
        seed=args.seed,
        half=half,
        young=float(args.initial is None),
        squares=args.squares,
        history=args.history,
        structure=args.structure,
        structure_ef=args.structure if args.structure_ef is None else args.structure_ef,
        extrapolated=args.extrapolated,
        masking=args.masking,
        holes=args.holes,
        augment=args.augment,
        compiled=args.compile,
        second_color=args.second_color or ("newest" if initial is None else initial.weights.second_color),
        hole_fill=shards[0].hole_fill,
        steady=args.steady,
        aliased=initial is not None and initial.made_for_aliased,
        data=digest_of(shards),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.train``."""
    args = parse(arguments)
    if args.threads:
        torch.set_num_threads(args.threads)
    if args.compile and shutil.which(os.environ.get("CXX", "g++")) is None:
        raise InputError("--compile: expected a C++ compiler, g++ or what CXX names; found none")
    if args.initial is not None and not args.resume:
        for path in filter(Path.exists, (args.out / name for name in FILES)):
            require_places({"--out": path}, [Path(args.initial)])
    device = device_of(args.device)
    initial = None if args.initial is None else load(args.initial)
    shards = load_shards(args.data, initial and initial.weights)
    settings = settings_of(args, initial, shards, device)
    state = start(settings, device, args.initial)
    path = args.out / "state.safetensors"
    if path.exists():
        if not args.resume:
            raise InputError(f"{args.out}: holds a run; --resume goes on with it")
        checkpoint.read(path, state, device)
    args.out.mkdir(parents=True, exist_ok=True)
    plan = Plan(args.steps, args.validate, args.log, args.most)
    torch.set_flush_denormal(True)  # the momentum of a dead unit becomes denormal, and then a step takes twice the time
    try:
        train(args.out, shards, state, settings, plan, device)
    finally:
        torch.set_flush_denormal(False)


if __name__ == "__main__":
    command(main)
