# SPDX-License-Identifier: MIT
"""``stss methods``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from stss.cli.options import (
    backend_options,
    frame_options,
    perceptual_options,
    sequence_options,
    weights_option,
)
from stss.frames.compute_options import ComputeOptions
from stss.pages.viewer import page_folder
from stss.quality.flip_vmaf import Perceptual
from stss.sequence.reader import SequenceOptions
from stss_ground.commands import Subcommand
from stss_ground.option_kinds import Names, ReadPath, WrittenFile, WrittenFolder
from stss_ground.output.places import require_places
from stss_ground.progress import show_progress, track
from stss_ground.terminal import Terminal, echo


@click.command("methods", cls=Subcommand)
@click.argument("sequence", type=ReadPath())
@click.argument("truth", type=ReadPath())
@click.option("-o", "--out", type=WrittenFolder(), required=True, help="Folder, with one folder for each method.")
@sequence_options
@weights_option
@click.option(
    "--methods",
    type=Names(),
    default=(),
    help="The methods to run, such as taau,network,without-erm  [default: all but without-*]",
)
@click.option(
    "--with",
    "others",
    type=ReadPath(),
    multiple=True,
    help="Folder of frames that another program made from SEQUENCE; the row has the folder's name.",
)
@backend_options
@frame_options
@click.option("--overwrite", is_flag=True, help="Replace the files of an earlier run.")
@click.option("--html", type=WrittenFile(), help="File for an HTML page with every method, frame by frame; it works offline.")
@perceptual_options
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def methods_command(
    sequence: Path,
    truth: Path,
    out: Path,
    reading: SequenceOptions,
    weights: str,
    methods: tuple[str, ...],
    others: tuple[Path, ...],
    html: Path | None,
    perceptual: Perceptual,
    as_json: bool,
    backend: str,
    compute: ComputeOptions,
    **output: Any,
) -> None:
    """Run SEQUENCE with the network and with methods that have none, and compare all with TRUTH: one table, and a page with --html.

    Columns are means over the frames of a kind; --json has every frame. without-history, -mask, -erm, -gbuffer and -second remove that
    part of the network; the reference computes them.
    """
    from stss.run.job import folder_of
    from stss.run.options import RunOptions
    from stss.sequence.choose_weights import choose_weights
    from stss_lab.baselines.registry import METHODS, open_method
    from stss_lab.methods import methods_table as method_table
    from stss_lab.methods.methods_page import methods_page

    bar = partial(track, console=Terminal(stderr=True))
    files = reading.open(sequence, bar)
    reads = [Path(weights), *(path for folder in (truth, *others) if folder.is_dir() for path in folder.iterdir())]
    options = RunOptions.of(files.profile, **output)
    names = method_table.choose_methods(methods, weights)
    method_table.require_names(names, others)
    loaded = choose_weights(weights, files, partial(echo, err=True), needed=not METHODS.keys() >= {*names})
    folders = [*(folder_of(out / method) for method in names), *([] if html is None else [page_folder(html)])]
    require_places({"--html": html}, [*files.tables, *reads], folders=folders, inputs=files.images)
    console, tell = Terminal(stderr=True), partial(echo, err=True)
    engines = {name: partial(open_method, name, loaded, backend, compute, tell=tell) for name in names}
    first, last = options.frames or (files.numbers[0], files.numbers[-1])
    with show_progress(console, (2 * len(names) + len(others)) * (last - first + 1)) as advance:
        results = method_table.run_methods(
            files, truth, out, engines, options, perceptual=perceptual, on_frame=advance, reads=reads, others=others
        )
    if html is not None:
        methods_page(html, results, truth, files, options.frames, bar)
    if as_json:
        click.echo(method_table.to_json(results))
    else:
        method_table.print_results(results, Terminal())
