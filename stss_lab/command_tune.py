# SPDX-License-Identifier: MIT
"""``stss tune``."""

from __future__ import annotations

import click

from stss.images.headers import MAX_SIDE
from stss_ground.commands import Subcommand
from stss_ground.option_kinds import Size
from stss_ground.terminal import Terminal


@click.command(cls=Subcommand)
@click.option("--device", help="Part of the name of the OpenCL device.")
@click.option("--size", type=Size(MAX_SIDE), default=(540, 960), show_default="960x540", help="Size of the inputs.")
def tune(device: str | None, size: tuple[int, int]) -> None:
    """Find the fastest tile sizes for a device and store them."""
    from stss_lab.tune import tune as tuning

    tuning.run(device, size, console=Terminal(), log=Terminal(stderr=True))
