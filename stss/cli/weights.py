# SPDX-License-Identifier: MIT
"""``stss weights``: import and inspect."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import click

from stss.images.headers import MAX_SIDE
from stss.weights import inspect as inspection
from stss.weights.checkpoint import read_checkpoint
from stss.weights.file import MADE_FOR, load, save
from stss_ground.commands import Subcommand
from stss_ground.option_kinds import ReadName, ReadPath, Size, WrittenFile
from stss_ground.terminal import Terminal, echo, printable


@click.group()
def weights() -> None:
    """Import and inspect the network's weights."""


@weights.command("import", cls=Subcommand)
@click.argument("checkpoint", type=ReadPath())
@click.option("-o", "--out", type=WrittenFile(), required=True, help="The .safetensors file to write.")
def import_weights(checkpoint: Path, out: Path) -> None:
    """Read the authors' PyTorch CHECKPOINT, without executing it, and write it as safetensors."""
    save(out, read_checkpoint(checkpoint), {"imported_from": printable(checkpoint.name)})
    echo(f"{out}: {load(out).identity}")


@weights.command(cls=Subcommand)
@click.argument("file", type=ReadName())
@click.option(
    "--size", type=Size(MAX_SIDE), default=(544, 960), show_default="960x544", help="Size of the inputs, for the multiply-adds."
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def inspect(file: str, size: tuple[int, int], as_json: bool) -> None:
    """Print the layers of the weights in FILE: shapes, parameters, multiply-adds."""
    loaded = load(file)
    summary = inspection.inspect(loaded.weights, *size)
    if as_json:
        click.echo(json.dumps({**asdict(summary), MADE_FOR: loaded.metadata.get(MADE_FOR)}))
    else:
        inspection.print_inspection(summary, Terminal())
        if loaded.made_for_aliased:
            echo("made for: aliased frames; stss run mixes images with earlier ones, unless --no-accumulate is given")
