# SPDX-License-Identifier: MIT
"""``stss port``: our own backends, and any Python port, as programs that the judge can start."""

from __future__ import annotations

from pathlib import Path

import click

from stss_ground.commands import Subcommand
from stss_ground.errors import InputError
from stss_ground.option_kinds import ReadPath


@click.command(cls=Subcommand)
@click.argument("job", type=ReadPath(), required=False)
@click.option("--backend", type=click.Choice(["ref", "cl"]), default="ref", show_default=True, help="NumPy, or OpenCL.")
@click.option("--port", "spec", metavar="MODULE:FACTORY", help="A Python port in place of a backend.")
@click.option("--dump", is_flag=True, help="Write the output of each layer of the network, too: folder layers of a case.")
@click.option("--serve", is_flag=True, help="Read the folders of jobs from standard input, one a line, and compute each.")
def port(job: Path | None, backend: str, spec: str | None, dump: bool, serve: bool) -> None:
    """Compute every case of the folder JOB, as any port does: see docs/ports.md."""
    from stss.port import run_job

    if (job is None) != serve:
        raise InputError("expected either a job folder or --serve")
    run_job(job, backend, spec, dump=dump)
