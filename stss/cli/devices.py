# SPDX-License-Identifier: MIT
"""Subcommands about devices; they import their modules when they run."""

from __future__ import annotations

from functools import partial

import click

from stss_ground.commands import Subcommand
from stss_ground.terminal import Terminal, echo


@click.command(cls=Subcommand)
@click.option("--again", is_flag=True, help="Test again, even where a verdict is stored.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def devices(again: bool, as_json: bool) -> None:
    """List the OpenCL devices and whether they agree with the reference."""
    from stss.devices import selection as found

    rows = found.rows(again=again, tell=partial(echo, err=True))
    if as_json:
        click.echo(found.to_json(rows))
    else:
        found.print_rows(rows, Terminal())
