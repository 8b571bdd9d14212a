# SPDX-License-Identifier: MIT
"""``stss port``: our own backends as programs that the judge can start."""

from __future__ import annotations

from pathlib import Path

import click

from stss_ground.option_kinds import PATH


@click.command()
@click.argument("job", type=PATH)
@click.option("--backend", type=click.Choice(["ref", "cl"]), default="ref", show_default=True)
@click.option("--dump", is_flag=True, help="Leave what each layer of the network gives, too: folder layers of a case.")
def port(job: Path, backend: str, dump: bool) -> None:
    """Compute every case of the folder JOB, as any port does: see docs/ports.md."""
    from stss.port import run_job

    run_job(job, backend, dump=dump)
