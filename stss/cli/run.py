# SPDX-License-Identifier: MIT
"""``stss run``: the main job."""

from __future__ import annotations

import math
import sys
import time
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import click
from rich.console import Console

from stss.cli.options import (
    backend_options,
    frame_options,
    sequence_options,
    weights_option,
)
from stss.cluster.chunk import Engine
from stss.cluster.run import run_on_cluster
from stss.frames.backends import open_backend
from stss.frames.compute_options import ComputeOptions
from stss.images.color import chromaticities, same_primaries
from stss.run.frame_job import FrameReport, describe, number_of, reason_to_replace, require_one_run
from stss.run.job import Summary, folder_of, plan_run
from stss.run.job import run as run_sequence
from stss.run.options import RunOptions
from stss.run.skip_report import Tally, describe_costs
from stss.sequence.choose_weights import choose_weights
from stss.sequence.reader import SequenceOptions
from stss.sequence.sequence import Sequence
from stss_ground.arguments import listing
from stss_ground.commands import Subcommand
from stss_ground.option_kinds import ReadPath, WrittenFolder
from stss_ground.output.folder import SUMS
from stss_ground.progress import show_progress, track
from stss_ground.terminal import Terminal, echo, printable
from stss_ref.schedule import FrameKind

MANY_HOLES = 0.4
"""Share of the static surfaces from which a run advises a check. Found: up to 0.18 in right sequences of fast cameras, 0.6 where motion
has the wrong sign."""


@click.command(cls=Subcommand)
@click.argument("sequence", type=ReadPath())
@click.option("-o", "--out", type=WrittenFolder(), required=True, help="Folder for the frames.")
@sequence_options
@weights_option
@backend_options
@frame_options
@click.option(
    "--format", "suffix", type=click.Choice(["exr", "png"]), default="exr", show_default=True, help="Format of the frames."
)
@click.option("--resume", is_flag=True, help="Go on after a stop: keep frames of the earlier run that are still right.")
@click.option("--overwrite", is_flag=True, help="Replace the files of an earlier run.")
@click.option("--cluster", help="Compute on local:N processes, or on the workers of a scheduler: tcp://host:8786.")
@click.option("--keep-going", is_flag=True, help="Leave out frames that cannot be read; ends with status 1.")
def run(
    sequence: Path,
    out: Path,
    reading: SequenceOptions,
    weights: str,
    backend: str,
    compute: ComputeOptions,
    suffix: str,
    cluster: str | None,
    keep_going: bool,
    **others: Any,
) -> None:
    """Double the size and the frame rate of SEQUENCE, a folder or a pattern like a.####.exr."""
    console = Terminal(stderr=True)
    frames = reading.open(sequence, partial(track, console=console, text="reading headers"), keep_going=keep_going)
    _tell_of_reading(frames, reading)
    options = RunOptions.of(frames.profile, format=suffix, keep_going=keep_going, **others)
    if suffix == "png":
        _tell_of_png(frames, options)
    reads = [Path(weights)]
    loaded = choose_weights(weights, frames, _tell)
    # The user's mistakes are said before a device is opened, which may take a minute.
    folder = plan_run(frames, out, options, reads).folder
    require_one_run(folder, options, describe(frames, options, "", "", loaded.label))
    first, last = options.frames or (frames.numbers[0], frames.numbers[-1])
    start, tally = time.monotonic(), Tally()
    try:
        waits = "building kernels" if cluster is None else "waiting for workers"
        with show_progress(console, last - first + 1, text=waits) as advance:

            def on_frame(report: FrameReport) -> None:
                advance(tally.add(report.cost))

            if cluster is not None:
                summary = run_on_cluster(frames, out, cluster, Engine(loaded, backend, compute), options, on_frame, reads)
            else:
                engine = open_backend(backend, loaded, compute, tell=_tell)
                settings = describe(frames, options, engine.method, engine.name, loaded.label)
                if reason := reason_to_replace(folder, options, settings):
                    _tell(f"--resume: {reason}; such frames are made again")
                summary = run_sequence(frames, out, engine, loaded.label, options, on_frame, reads)
    except KeyboardInterrupt:
        echo(
            f"stss: stopped; to go on, give the same command with --resume{' in place of --overwrite' if options.overwrite else ''}",
            err=True,
        )
        sys.exit(130)
    _report(summary, out, console)
    _tell_of_others(summary, out, options)
    _tell(_speed(summary, frames.size, time.monotonic() - start))
    sys.exit(1 if any(frame.fault for frame in summary.frames) else 0)


def _tell_of_reading(frames: Sequence, reading: SequenceOptions) -> None:
    if reading.profile is None:
        _tell(f"profile: {frames.profile.name}, by the channels' names; --profile takes another")
    for note in frames.notes:
        _tell(note)
    if frames.solves_camera:
        _tell("camera: from position and depth; --camera CSV gives another")
    if reading.static == "camera":
        _tell("motion: of the background and of static geometry it is computed from the camera")
    elif reading.background == "camera":
        _tell("background: its motion is computed from the camera; the files' motion is not used there")
    for buffer, value in (("roughness", reading.roughness), ("metallic", reading.metallic)):
        if value is not None and buffer in frames.first.sources:
            _tell(f"{buffer}: the files have {frames.first.sources[buffer].names[0]}; --{buffer} is not used")


def _tell_of_png(sequence: Sequence, options: RunOptions) -> None:
    if others := sequence.carries(options.also):
        _tell(f"png: without {', '.join(others)}; --format exr has them")
    colored = (frame for number in sequence.numbers if "color" in (frame := sequence.frames[number]).sources)
    primaries = chromaticities(next(colored, sequence.first).attributes)
    if not same_primaries(primaries):
        words = ", ".join(f"{x:.4g}" for x in primaries)
        _tell(f"png: the colours' primaries are not sRGB's ({words}), and are not converted: a viewer shows other colours")


def _tell_of_others(summary: Summary, out: Path, options: RunOptions) -> None:
    """Name frames that --resume left: the sequence got shorter, or they could not be made again."""
    own = {frame.number for frame in summary.frames if frame.outcome != "left out"}
    first, last = options.frames or (-math.inf, math.inf)
    names = {path.name for path in folder_of(out).present() if path.name != SUMS}
    if others := sorted(name for name in names if number_of(name) not in own and first <= number_of(name) <= last):
        _tell(f"of an earlier run, not of this one: {listing(others, 4)}; --overwrite removes them")


def _tell(line: str) -> None:
    echo(line, err=True)


def _speed(summary: Summary, size: tuple[int, int], seconds: float) -> str:
    count, (height, width) = summary.count("done"), size
    return (
        f"{count} frames, {2 * width} x {2 * height} from {width} x {height}, in {seconds:.1f} s: {count / seconds:.2f} a second"
    )


def _report(summary: Summary, out: Path, console: Console) -> None:
    def text(frame: FrameReport) -> str:
        return frame.reason if frame.reason.startswith("frame ") else f"frame {frame.number}: {frame.reason}"

    for frame in summary.frames:
        if frame.outcome == "left out":
            console.print(printable(f"left out: {text(frame)}"), soft_wrap=True, markup=False, highlight=False)
    counts = ", ".join(f"{summary.count('done', kind)} {kind.value}" for kind in FrameKind)
    rest = f"{summary.count('kept')} kept, {summary.count('left out')} left out"
    console.print(printable(f"{out}: {counts} written, {rest}"), soft_wrap=True, markup=False, highlight=False)
    peak = max((frame.peak for frame in summary.frames), default=0.0)
    if peak > 1:
        console.print(f"highlights: up to {peak:.3g}; --format png and --transfer none clip at 1", soft_wrap=True)
    holes = {frame.number: frame.static_holes for frame in summary.frames if frame.static_holes is not None}
    if shares := list(holes.values()):
        share = sum(shares) / len(shares)
        advice = "; so many that motion or positions may be wrong: see stss check" if share > MANY_HOLES else ""
        console.print(f"holes: {share:.1%} of the static surfaces, in {len(shares)} EF{advice}", soft_wrap=True)
        if len(shares) > 2 and median(shares) < MANY_HOLES / 2:
            for number in [number for number, of in holes.items() if of > MANY_HOLES]:
                text = f"{holes[number]:.1%} of the static surfaces in frame {number} alone: a cut? Render it, and give --cuts {number}"
                console.print(f"holes: {text}", soft_wrap=True)
    if costs := [frame.cost for frame in summary.frames if frame.cost]:
        console.print(describe_costs(costs), soft_wrap=True, markup=False, highlight=False)
