# SPDX-License-Identifier: MIT
"""``stss`` where the judge is installed alone: what needs neither device nor frames."""

from __future__ import annotations

import click

from stss.cli.conform import conform, port
from stss_ground.guard import run_guarded
from stss_ground.optional import require_own_conformance
from stss_ground.version import VERSION
from stss_ref.arrays import ArrayError
from stss_ref.weights import WeightsError


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120})
@click.version_option(VERSION, prog_name="stss")
def judge() -> None:
    """Judge ports of space-time supersampling: the part of stss that needs neither OpenCL nor image files."""
    require_own_conformance()


for command in (conform, port):
    judge.add_command(command)


def main() -> None:
    """Run the command."""
    run_guarded(judge, ArrayError, WeightsError)
