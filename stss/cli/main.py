# SPDX-License-Identifier: MIT
"""The ``stss`` command: one function per subcommand, each of them thin."""

from __future__ import annotations

import json
import os
import sys
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from stss.baselines.registry import METHODS
from stss.cli.bench import bench_command, export, gpu_report_command
from stss.cli.conform import conform, port
from stss.cli.devices import devices, tune
from stss.cli.evaluate import compare_command, flicker_command, methods_command
from stss.cli.options import (
    SIDE,
    FrameRange,
    backend_options,
    frame_options,
    sequence_options,
    skip_options,
    weights_option,
)
from stss.cli.progress import shown_progress
from stss.cli.stress import stress_command
from stss.cluster.run import Cluster, require_independent, run_on_cluster
from stss.frames.backends import NETWORK
from stss.frames.compute_options import ComputeOptions, Skip
from stss.run.choose_backend import first_frames, open_method, with_skipping, within_budget
from stss.run.frame_job import FrameReport
from stss.run.job import Summary
from stss.run.job import run as run_sequence
from stss.run.options import RunOptions
from stss.run.preview import Preview, require_preview
from stss.run.skip_report import told
from stss.sequence.choose_weights import choose_weights
from stss.sequence.reader import open_sequence
from stss.weights import inspect as inspection
from stss.weights.checkpoint import read_checkpoint
from stss.weights.file import load, save
from stss_cl.device.caches import private
from stss_ground.errors import DeviceError, InputError
from stss_ground.guard import run_guarded
from stss_ground.option_kinds import PATH
from stss_ground.optional import installed, require_own_conformance
from stss_ground.output.apart import require_places
from stss_ground.terminal import Terminal, echo, printable
from stss_ground.version import VERSION
from stss_ref.arrays import ArrayError
from stss_ref.schedule import FrameKind
from stss_ref.weights import WeightsError


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120})
@click.version_option(VERSION, prog_name="stss")
def stss() -> None:
    """Space-time supersampling: frames in, twice the resolution and twice the frame rate out."""
    require_own_conformance()


@stss.command()
@click.argument("sequence", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder for the frames.")
@sequence_options
@weights_option
@click.option(
    "--method",
    type=click.Choice([NETWORK, *METHODS]),
    default=NETWORK,
    show_default=True,
    help="The network, or a method without weights and device to compare with.",
)
@backend_options
@skip_options
@frame_options
@click.option("--format", "suffix", type=click.Choice(["exr", "png"]), default="exr", show_default=True)
@click.option("--resume", is_flag=True, help="Keep the frames of an earlier run that are still right.")
@click.option("--overwrite", is_flag=True, help="Replace what an earlier run wrote.")
@click.option("--show-skipped", is_flag=True, help="Pictures of where each frame was computed, in OUT/skipped.")
@click.option("--preview", type=PATH, help="A .png that shows the newest frame every ten seconds.")
@click.option("--cluster", help="Compute on local:N processes, or on the workers of a scheduler: tcp://host:8786.")
@click.option(
    "--mixed-devices", is_flag=True, help="With --cluster: accept workers whose devices differ, and so the bits of their frames."
)
@click.option("--keep-going", is_flag=True, help="Leave out frames that cannot be read; ends with status 1.")
def run(
    sequence: Path,
    out: Path,
    profile: str | None,
    camera: Path | None,
    metallic: float | None,
    roughness: float | None,
    non_finite: Any,
    weights: str,
    method: str,
    backend: str,
    compute: ComputeOptions,
    skip: Skip | None,
    budget: float | None,
    suffix: str,
    preview: Path | None,
    cluster: str | None,
    mixed_devices: bool,
    **chosen: Any,
) -> None:
    """Make SEQUENCE, a folder or a pattern like a.####.exr, twice as large and twice as fast."""
    frames = open_sequence(sequence, profile, camera=camera, metallic=metallic, roughness=roughness, non_finite=non_finite)
    if profile is None:
        _tell(f"profile: {frames.profile.name}, by the channels' names; --profile takes another")
    if frames.solves_camera:
        _tell("camera: from position and depth; --camera CSV takes one")
    options = RunOptions.of(frames.profile, format=suffix, **chosen)
    console = Terminal(stderr=True)
    possible = backend == "cl" and method == NETWORK
    reads = [Path(weights)]
    if preview is not None:
        require_preview(preview, [*frames.reads, *reads])
    loaded = choose_weights(weights, frames, _tell, needed=method == NETWORK)
    compute = with_skipping(compute, skip, budget, possible=possible)
    if cluster is None and mixed_devices:
        raise InputError("--mixed-devices: expected --cluster as well")
    first, last = options.frames or (frames.numbers[0], frames.numbers[-1])
    try:
        with shown_progress(console, last - first + 1, preview and Preview(preview, out, options)) as on_frame:
            if cluster is not None:
                require_independent(method, budget)
                where = Cluster(cluster, mixed_devices)
                summary = run_on_cluster(frames, out, where, method, loaded, backend, compute, options, on_frame, reads)
            else:
                if budget is None:
                    engine, label = open_method(method, loaded, backend, compute, tell=_tell)
                else:
                    engine, label = within_budget(loaded, compute, budget, first_frames(frames, options), tell=_tell)
                summary = run_sequence(frames, out, engine, label, options, on_frame, reads)
    except KeyboardInterrupt:
        echo(
            f"stss: stopped; to go on, give the same command with --resume{' in place of --overwrite' if options.overwrite else ''}",
            err=True,
        )
        sys.exit(130)
    _report(summary, out, console)
    sys.exit(1 if any(frame.fault for frame in summary.frames) else 0)


@stss.command()
@click.argument("sequence", type=PATH)
@sequence_options
@click.option("--frames", type=FrameRange(), help="First and last frame to look at.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def check(sequence: Path, profile: str | None, as_json: bool, **options: Any) -> None:
    """Say what SEQUENCE holds and whether it can be run.

    Ends with status 0 when it can, 1 when it can but something looks wrong, 2 when it cannot.
    """
    from stss.check_sequence import report as checking

    report = checking.check(sequence, profile, **options)
    if as_json:
        click.echo(report.to_json())
    else:
        checking.print_report(report, Terminal())
    sys.exit(report.status)


@stss.command()
@click.argument("out", type=PATH, default=Path("demo"))
@weights_option
@backend_options
@click.option("--overwrite", is_flag=True, help="Replace an earlier demo.")
def demo(out: Path, weights: str, overwrite: bool, **chosen: Any) -> None:
    """Render a small scene into OUT, supersample it, and compare it with its truth: pictures to look at."""
    from stss import demo as demonstration

    demonstration.demo(out, weights=weights, overwrite=overwrite, console=Terminal(), **chosen)


@stss.group()
def weights() -> None:
    """Import and inspect the network's weights."""


@weights.command("import")
@click.argument("checkpoint", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="The .safetensors file to write.")
def import_weights(checkpoint: Path, out: Path) -> None:
    """Read the authors' PyTorch CHECKPOINT, without executing it, and write it as safetensors."""
    require_places({"--out": out}, [checkpoint])
    save(out, read_checkpoint(checkpoint), {"imported_from": printable(checkpoint.name)})
    echo(f"{out}: {load(out).identity}")


@weights.command()
@click.argument("file")
@click.option("--size", type=(SIDE, SIDE), default=(544, 960), show_default=True, help="H W for the multiply-adds.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def inspect(file: str, size: tuple[int, int], as_json: bool) -> None:
    """Print the layers of the weights in FILE: shapes, parameters, multiply-adds."""
    found = inspection.inspect(load(file).weights, *size)
    if as_json:
        click.echo(json.dumps(asdict(found)))
    else:
        inspection.print_inspection(found, Terminal())


for command in (
    bench_command, compare_command, conform, devices, export, flicker_command, gpu_report_command,
    methods_command, port, stress_command, tune,
):  # fmt: skip
    stss.add_command(command)


def _tell(line: str) -> None:
    echo(line, err=True)


def _report(summary: Summary, out: Path, console: Console) -> None:
    def text(frame: FrameReport) -> str:
        return frame.reason if frame.reason.startswith("frame ") else f"frame {frame.number}: {frame.reason}"

    for frame in summary.frames:
        if frame.outcome == "left out":
            console.print(printable(f"left out: {text(frame)}"), soft_wrap=True, markup=False, highlight=False)
    written = ", ".join(f"{summary.count('done', kind)} {kind.value}" for kind in FrameKind)
    rest = f"{summary.count('kept')} kept, {summary.count('left out')} left out"
    console.print(printable(f"{out}: {written} written, {rest}"), soft_wrap=True, markup=False, highlight=False)
    peak = max((frame.peak for frame in summary.frames), default=0.0)
    if peak > 1:
        console.print(f"highlights: up to {peak:.3g}; --format png and --transfer none clip at 1", soft_wrap=True)
    if costs := [frame.cost for frame in summary.frames if frame.cost]:
        console.print(told(costs), soft_wrap=True, markup=False, highlight=False)


def main() -> None:
    """Run the command; a mistake of the user is one line on standard error and status 2."""
    if installed("matplotlib"):
        # For Matplotlib, which colour-science imports and which else stores files beside other programs'. A failure here must not
        # stop a command that needs no device.
        with suppress(DeviceError):
            os.environ.setdefault("MPLCONFIGDIR", str(private("matplotlib")))
    run_guarded(stss, ArrayError, WeightsError)
