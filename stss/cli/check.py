# SPDX-License-Identifier: MIT
"""``stss check`` and ``stss demo``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from stss.cli.options import (
    FrameRange,
    backend_options,
    sequence_options,
    weights_option,
)
from stss.sequence.reader import SequenceOptions
from stss_ground.commands import Subcommand
from stss_ground.option_kinds import ReadPath, WrittenFolder
from stss_ground.terminal import Terminal


@click.command(cls=Subcommand)
@click.argument("sequence", type=ReadPath())
@sequence_options
@click.option("--frames", type=FrameRange(), help="First and last frame to check.")
@click.option("--all", "all_values", is_flag=True, help="Look at the values of all frames, as a run does, not of six.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def check(sequence: Path, reading: SequenceOptions, frames: tuple[int, int] | None, all_values: bool, as_json: bool) -> None:
    """List the contents of SEQUENCE, and say whether it can be run.

    Reads the headers of all frames, and the pixels of six: three pairs, evenly spread.
    Ends with status 0 when it can, 1 when it can but something looks wrong, 2 when it cannot.
    """
    from stss.check_sequence import report as checking

    report = checking.check(sequence, reading, frames=frames, all_values=all_values, console=Terminal(stderr=True))
    if as_json:
        click.echo(report.to_json())
    else:
        checking.print_report(report, Terminal())
    sys.exit(report.status)


@click.command(cls=Subcommand)
@click.argument("out", type=WrittenFolder(), default=Path("demo"))
@weights_option
@backend_options
@click.option("--overwrite", is_flag=True, help="Replace an earlier demo.")
def demo(out: Path, weights: str, overwrite: bool, **options: Any) -> None:
    """Render a small scene into OUT, supersample it, and compare it with its truth: pictures to look at."""
    from stss import demo as demonstration

    demonstration.demo(out, weights=weights, overwrite=overwrite, console=Terminal(), **options)
