# SPDX-License-Identifier: MIT
"""``stss compare``."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from stss.cli.options import (
    FrameRange,
    perceptual_options,
    sequence_options,
)
from stss.pages.viewer import page_folder
from stss.quality.flip_vmaf import Perceptual
from stss.sequence.reader import SequenceOptions
from stss_ground.commands import Subcommand
from stss_ground.option_kinds import ReadPath, WrittenFile
from stss_ground.output.places import require_places
from stss_ground.progress import track
from stss_ground.terminal import Terminal, echo


@click.command("compare", cls=Subcommand)
@click.argument("out", type=ReadPath())
@click.argument("truth", type=ReadPath())
@click.option("--frames", type=FrameRange(), help="First and last frame to compare.")
@click.option(
    "--html", type=WrittenFile(), help="File for an HTML page with slider, flicker, difference and plots; it works offline."
)
@click.option("--sequence", type=ReadPath(), help="The input of OUT: its motion gives the flicker, and the page shows it.")
@click.option(
    "--holes",
    type=ReadPath(),
    help="Folder of another run: score over its holes, since two runs may have different ones and another program's frames none.",
)
@sequence_options
@perceptual_options
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def compare_command(
    out: Path,
    truth: Path,
    frames: tuple[int, int] | None,
    html: Path | None,
    sequence: Path | None,
    holes: Path | None,
    reading: SequenceOptions,
    perceptual: Perceptual,
    as_json: bool,
) -> None:
    """Compare the frames in OUT with those in TRUTH: PSNR and SSIM over all pixels, edges and holes.

    Each is a folder, or a pattern like a.####.exr.
    """
    from stss.quality import compare as comparing
    from stss.quality import comparison_page as pages
    from stss.quality.output_and_truth import find_pairs

    bar = partial(track, console=Terminal(stderr=True))
    files = None if sequence is None else reading.open(sequence, bar)
    pairs = find_pairs(out, truth, frames, reading.non_finite, holes)[0]
    require_places(
        {"--html": html},
        () if files is None else files.reads,
        folders=[] if html is None else [page_folder(html)],
        inputs=comparing.files_of(pairs),
    )
    comparison = comparing.compare(
        out, truth, frames=frames, sequence=files, perceptual=perceptual, non_finite=reading.non_finite, holes=holes, track=bar
    )
    if as_json:
        click.echo(comparison.to_json())
    else:
        comparing.print_comparison(comparison, Terminal())
    if html is not None:
        methods = ", ".join(comparison.made_with.get("method", ())) or "another program"
        version = pages.Version("output", f"Made by {methods}: what is compared.", pairs, comparison)
        inputs = None if files is None else pages.RenderedInputs(files, pairs)
        pages.write_comparison(html, f"{out.name}, compared with the truth in {truth.name}", [version], inputs, track=bar)
        echo(f"page to look at: {html}", err=True)
