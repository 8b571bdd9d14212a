# SPDX-License-Identifier: MIT
"""``stss gather``: parts of a run into one folder."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import click

from stss.cli.options import FrameRange
from stss.run.gather import gather as gather_parts
from stss_ground.commands import Subcommand
from stss_ground.option_kinds import ReadPath, WrittenFolder
from stss_ground.progress import track
from stss_ground.terminal import Terminal, echo


@click.command(cls=Subcommand)
@click.argument("parts", type=ReadPath())
@click.option("-o", "--out", type=WrittenFolder(), required=True, help="Folder for the frames.")
@click.option("--sequence", type=ReadPath(), help="The input frames of the parts: nothing is written there.")
@click.option(
    "--frames", type=FrameRange(), help="First and last frame that must be there afterwards  [default: those of the parts]"
)
@click.option("--overwrite", is_flag=True, help="Replace the files of an earlier run.")
def gather(parts: Path, out: Path, sequence: Path | None, frames: tuple[int, int] | None, overwrite: bool) -> None:
    """Move the frames of partial runs (--frames), each in a folder below PARTS, into one folder like that of one run.

    Ends with status 1 where a frame is missing.
    """
    bar = partial(track, console=Terminal(stderr=True), unit="parts")
    result = gather_parts(parts, out, sequence, frames=frames, overwrite=overwrite, track=bar)
    echo(f"{out}: {result.frames} frames, gathered from {result.parts} part{'s' * (result.parts != 1)}")
    if len(result.makers) > 1:
        echo(f"made by: {'; '.join(result.makers)}: the last bits of their frames may differ", err=True)
    if result.missing:
        more = f", ... ({result.missing} in all)" if result.missing > len(result.first_missing) else ""
        numbers = ", ".join(map(str, result.first_missing)) + more
        echo(f"missing: frames {numbers}: in no part and not in {out}; run their task again, then gather once more", err=True)
    sys.exit(1 if result.missing else 0)
