# SPDX-License-Identifier: MIT
"""Subcommands about other engines; they import their modules when they run."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import click

from stss.cli.options import MAX_COUNT
from stss.images.headers import MAX_SIDE
from stss.weights.file import identity, load
from stss_ground.commands import Subcommand, gather_options, refuse_options
from stss_ground.errors import InputError
from stss_ground.option_kinds import Names, ReadName, Size, WrittenFile, WrittenFolder
from stss_ground.output.write_whole import write_named
from stss_ground.progress import show_steps
from stss_ground.terminal import Terminal, echo

if TYPE_CHECKING:
    from stss_lab.bench.contender import Setup


@dataclass(frozen=True)
class SetupChoice:
    """The conditions that every engine is timed under: the options of these names."""

    sizes: tuple[tuple[int, int], ...]
    weights: str | None
    dark: bool
    device: str | None


@dataclass(frozen=True)
class ParetoChoice:
    """The measurement of time against error: the options of these names."""

    pareto: bool
    scenes: tuple[str, ...] | None
    settings: tuple[str, ...] | None
    frames: int


@click.command("bench", cls=Subcommand)
@gather_options(
    "The setup",
    "setup",
    SetupChoice,
    click.option(
        "--size",
        "sizes",
        type=Size(MAX_SIDE),
        multiple=True,
        default=((540, 960),),
        show_default="960x540",
        help="Size of the inputs; may be repeated.",
    ),
    click.option("--weights", type=ReadName(), help="A .safetensors file  [default: random weights]"),
    click.option("--dark", is_flag=True, help="Colours of 1e-38, which are subnormal numbers: does the time depend on the data?"),
    click.option("--device", help="Part of the name of the OpenCL device."),
)
@click.option("--repeat", type=click.IntRange(1, MAX_COUNT), default=10, show_default=True, help="Timed runs of each engine.")
@click.option(
    "--ours",
    type=Names(),
    default="cl",
    show_default=True,
    help="Our backends: ref, cl, cl-direct, cl-half, cl-bfloat16, cl-host, cl-frame, cl-stream, cl-stream-ahead, cl-push",
)
@click.option(
    "--peers",
    type=Names(),
    default="pytorch,onnxruntime,openvino,openvino-default",
    show_default=True,
    help="Other engines; the first one is 1 in all ratios.",
)
@click.option("--json", "json_file", type=WrittenFile(), help="File for all times, the versions and the machine.")
@click.option(
    "--launches",
    is_flag=True,
    help="Time each launch of the network instead, by the device's clock, beside its work: --ours alone.",
)
@gather_options(
    "Time against error",
    "tradeoff",
    ParetoChoice,
    click.option(
        "--pareto",
        is_flag=True,
        help="Measure time against error instead: every precision and skip mode, on the canonical scenes.",
    ),
    click.option("--scenes", type=Names(), help="With --pareto: the canonical scenes to run  [default: all]"),
    click.option(
        "--settings",
        type=Names(),
        help="With --pareto: the settings whose names contain one of these, such as float32,half off  [default: all but bfloat16]",
    ),
    click.option(
        "--frames", type=click.IntRange(10, MAX_COUNT), default=20, show_default=True, help="With --pareto: frames of each scene."
    ),
)
def bench_command(
    setup: SetupChoice,
    repeat: int,
    ours: tuple[str, ...],
    peers: tuple[str, ...],
    json_file: Path | None,
    launches: bool,
    tradeoff: ParetoChoice,
) -> None:
    """Time the network on our backends and on other engines, and measure the errors of all against the float64 reference."""
    from stss_ground.machine import available_threads
    from stss_lab.bench import report as bench_report
    from stss_lab.bench.contender import Setup
    from stss_lab.bench.measure import bench as run_bench
    from stss_lab.bench.measure import count_steps
    from stss_ref.weights import random as random_weights

    tensors = random_weights(0) if setup.weights is None else load(setup.weights).weights
    threads = available_threads()
    setups = [Setup(tensors, *size, device=setup.device, threads=threads, dark=setup.dark) for size in setup.sizes]
    if launches and tradeoff.pareto:
        raise InputError("--launches and --pareto: expected one of them")
    if not tradeoff.pareto:
        refuse_options("only with --pareto", ("scenes", "settings", "frames"))
    right = True
    if tradeoff.pareto:
        refuse_options("not with --pareto", ("ours", "repeat", "peers", "dark"))
        text = _measure_tradeoff(setups, tradeoff)
    elif launches:
        refuse_options("not with --launches", ("peers",))
        text = _time_launches(setups, ours, repeat)
    else:
        with show_steps(Terminal(stderr=True), count_steps(setups, ours, peers, repeat)) as begin:
            results = run_bench(setups, ours, peers, repeat, on_step=begin)
        bench_report.print_results(results, Terminal())
        text = bench_report.to_json(results, identity(tensors), threads, dark=setup.dark)
        right = not any(row.fault for result in results for row in result.rows)
    if json_file is not None:
        write_named(json_file, text)
    sys.exit(0 if right else 1)


def _time_launches(setups: list[Setup], ours: tuple[str, ...], repeat: int) -> str:
    """Time each launch and print the tables; returns them as JSON."""
    from stss_lab.bench import launches

    tables: list[launches.LaunchTimings] = []
    with show_steps(Terminal(stderr=True), len(setups) * len(ours)) as begin:
        for setup, name in product(setups, ours):
            begin(f"{setup.width}x{setup.height}: {name}")
            tables.append(launches.time_launches(setup, name, repeat))
    for table in tables:
        launches.print_launches(table, Terminal())
    return launches.to_json(tables, identity(setups[0].weights))


def _measure_tradeoff(setups: list[Setup], choice: ParetoChoice) -> str:
    """Measure time against error and print the points; returns them as JSON."""
    from stss_lab.bench import pareto

    settings = pareto.chosen_settings(choice.settings)
    points = pareto.bench_pareto(setups, choice.scenes, settings, choice.frames, Terminal(stderr=True))
    return pareto.to_json(points, setups[0], identity(setups[0].weights))


@click.command("gpu-report", cls=Subcommand)
@click.option("-o", "--out", type=WrittenFolder(), required=True, help="A new or an empty folder.")
@click.option("--device", help="Part of the name of the OpenCL device  [default: the first GPU]")
@click.option("--tiny", is_flag=True, help="Small sizes: only check that every step runs.")
def gpu_report_command(out: Path, device: str | None, tiny: bool) -> None:
    """Test, judge and time a GPU; the report is a folder whose README.md begins with the faults.

    Runs self-tests, tests and the judge, compares times with other engines, and finds tile sizes. Takes 25 minutes at most and needs no
    network. Ends with status 1 if something is wrong.
    """
    from stss_lab.bench.gpu_report import gpu_report

    good = gpu_report(out, device, tiny=tiny, console=Terminal(stderr=True))
    echo(f"{out / 'README.md'}")
    sys.exit(0 if good else 1)


@click.command(cls=Subcommand)
@click.argument("weights", type=ReadName())
@click.option("-o", "--out", type=WrittenFile(), required=True, help="The .onnx file to write.")
@click.option(
    "--size", type=Size(MAX_SIDE), default=(544, 960), show_default="960x544", help="Size of the inputs: multiples of 8."
)
def export(weights: str, out: Path, size: tuple[int, int]) -> None:
    """Write the network with WEIGHTS, for inputs of one size, as an ONNX model for other engines."""
    from stss_lab.bench import onnx_export

    onnx_export.write(out, load(weights).weights, *size)
    echo(f"{out}: {size[1]}x{size[0]} to {2 * size[1]}x{2 * size[0]}, opset {onnx_export.OPSET}")
