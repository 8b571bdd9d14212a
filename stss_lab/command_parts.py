# SPDX-License-Identifier: MIT
"""``stss parts``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from stss.cli.options import frame_options, sequence_options
from stss.run.options import RunOptions
from stss.sequence.reader import SequenceOptions
from stss.weights.file import load
from stss_ground.commands import Subcommand
from stss_ground.option_kinds import Names, ReadPath, WrittenFolder
from stss_ground.progress import show_progress, track
from stss_ground.terminal import Terminal


@click.command("parts", cls=Subcommand)
@click.argument("sequence", type=ReadPath())
@click.argument("truth", type=ReadPath())
@click.option("-o", "--out", type=WrittenFolder(), required=True, help="Folder, with one folder for each set of weights.")
@sequence_options
@click.option("--weights", type=Names(), required=True, help="Names or .safetensors files, such as realtime,arena.safetensors")
@click.option("--parts", type=Names(), default=(), help="The parts to remove: history,mask,erm,gbuffer,second  [default: all]")
@frame_options
@click.option("--overwrite", is_flag=True, help="Replace the files of an earlier run.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def parts_command(
    sequence: Path,
    truth: Path,
    out: Path,
    reading: SequenceOptions,
    weights: tuple[str, ...],
    parts: tuple[str, ...],
    as_json: bool,
    **others: Any,
) -> None:
    """Remove the network's parts, one at a time, and compare the results with TRUTH.

    The history becomes three copies of the newest frame, the mask 1, the ERM's output its mean, the G-buffer 0, the second colour the
    first. The weights stay: nothing is trained. Computed by the reference.
    """
    from stss_lab.methods import parts as table

    bar = partial(track, console=Terminal(stderr=True))
    files = reading.open(sequence, bar)
    options, names = RunOptions.of(files.profile, **others), parts or table.PARTS
    loaded = [load(name) for name in weights]
    first, last = options.frames or (files.numbers[0], files.numbers[-1])
    with show_progress(Terminal(stderr=True), 2 * len(loaded) * (1 + len(names)) * (last - first + 1)) as advance:
        results = table.take_away(files, truth, out, loaded, names, options, on_frame=advance)
    if as_json:
        click.echo(table.to_json(results))
    else:
        table.print_parts(results, Terminal())
