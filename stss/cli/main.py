# SPDX-License-Identifier: MIT
"""The ``stss`` command: the list of its subcommands. Each is imported when it is called."""

from __future__ import annotations

from importlib.metadata import entry_points
from importlib.util import find_spec

import click

from stss_ground.commands import Commands, Sections
from stss_ground.exit_status import run_guarded
from stss_ground.version import VERSION
from stss_ref.arrays import ArrayError
from stss_ref.weights import WeightsError

SECTIONS: Sections = {
    "Use": {
        "check": ("stss.cli.check:check", "Say what a sequence holds and whether it can be run."),
        "run": ("stss.cli.run:run", "Double the size and the frame rate of a sequence."),
        "gather": ("stss.cli.gather:gather", "Put the parts of a run into one folder."),
        "demo": ("stss.cli.check:demo", "Render a small scene, supersample it, compare it with its truth."),
        "weights": ("stss.cli.weights:weights", "Import and inspect the network's weights."),
    },
    "Compare": {
        "compare": ("stss.cli.compare:compare_command", "Compare frames with their truth."),
    },
    "Devices": {
        "devices": ("stss.cli.devices:devices", "List the OpenCL devices, each with its self-test."),
    },
    "Ports": {
        "conform": ("conformance.command:conform", "Judge a port."),
        "port": ("stss.cli.port:port", "Answer a folder of cases with a backend of ours."),
    },
}
"""Section of ``stss --help`` -> command -> its module and function, and its purpose."""
ENTRY_POINTS = "stss.commands"
"""Group of entry points by which other packages add commands; each names a table like `SECTIONS`."""


def list_sections() -> Sections:
    """List the commands of this package and, in the same sections, those that installed packages add."""
    sections = {heading: dict(commands) for heading, commands in SECTIONS.items()}
    for entry in entry_points(group=ENTRY_POINTS):
        if find_spec(entry.module.partition(".")[0]) is None:
            continue  # a wheel that was built without its laboratory
        for heading, commands in entry.load().items():
            own = sections.setdefault(heading, {})
            own |= {name: place for name, place in commands.items() if name not in own}
    return sections


@click.group(
    cls=Commands, sections=list_sections(), context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120}
)
@click.version_option(VERSION, prog_name="stss")
def stss() -> None:
    """Space-time supersampling: frames in, twice the resolution and twice the frame rate out."""


def main() -> None:
    """Run the command; a mistake of the user is one line on standard error and status 2."""
    run_guarded(stss, ArrayError, WeightsError)
