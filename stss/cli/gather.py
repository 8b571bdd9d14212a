# SPDX-License-Identifier: MIT
"""``stss gather``: parts of a run into one folder."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from stss.run.gather import gather as gather_parts
from stss_ground.commands import Subcommand
from stss_ground.option_kinds import ReadPath, WrittenFolder
from stss_ground.progress import track
from stss_ground.terminal import Terminal, echo


@click.command(cls=Subcommand)
@click.argument("parts", type=ReadPath())
@click.option("-o", "--out", type=WrittenFolder(), required=True, help="Folder for the frames.")
@click.option("--sequence", type=ReadPath(), help="The frames that the parts were made from: nothing is written there.")
@click.option("--overwrite", is_flag=True, help="Replace what an earlier run wrote.")
def gather(parts: Path, out: Path, sequence: Path | None, overwrite: bool) -> None:
    """Move the frames of runs with --frames, each in a folder below PARTS, into one folder, as one run would have left it."""
    bar = partial(track, console=Terminal(stderr=True), unit="parts")
    echo(f"{out}: frames of {gather_parts(parts, out, sequence, overwrite=overwrite, track=bar)} parts")
