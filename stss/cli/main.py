# SPDX-License-Identifier: MIT
"""The ``stss`` command: the list of its subcommands. Each is imported when it is called."""

from __future__ import annotations

import os
from contextlib import suppress

import click

from stss_cl.device.caches import private
from stss_ground.commands import Commands
from stss_ground.errors import DeviceError
from stss_ground.guard import run_guarded
from stss_ground.optional import installed
from stss_ground.version import VERSION
from stss_ref.arrays import ArrayError
from stss_ref.weights import WeightsError

SECTIONS = {
    "Use": {
        "check": ("stss.cli.check:check", "Say what a sequence holds and whether it can be run."),
        "run": ("stss.cli.run:run", "Make a sequence twice as large and twice as fast."),
        "gather": ("stss.cli.gather:gather", "Put the parts of a run into one folder."),
        "demo": ("stss.cli.check:demo", "Render a small scene, supersample it, compare it with its truth."),
        "weights": ("stss.cli.weights:weights", "Import and inspect the network's weights."),
    },
    "Compare": {
        "compare": ("stss.cli.evaluate:compare_command", "Compare frames with their truth."),
        "methods": ("stss_lab.command_methods:methods_command", "Compare the network with other methods."),
    },
    "Devices": {
        "devices": ("stss.cli.devices:devices", "List the OpenCL devices, and whether they are right."),
        "tune": ("stss_lab.command_tune:tune", "Find the fastest tile sizes for a device."),
    },
    "Ports": {
        "conform": ("conformance.command:conform", "Judge a port."),
        "port": ("stss.cli.port:port", "Answer a folder of cases with a backend of ours."),
        "export": ("stss_lab.command_bench:export", "Write the network as ONNX."),
    },
    "Measure": {
        "bench": ("stss_lab.command_bench:bench_command", "Time the network beside other engines."),
        "stress": ("stss_lab.command_stress:stress_command", "Measure errors on hard inputs."),
        "gpu-report": ("stss_lab.command_bench:gpu_report_command", "Test, judge and time this machine's GPU."),
    },
}
"""Section of ``stss --help`` -> command -> where it is, what it does."""


@click.group(cls=Commands, sections=SECTIONS, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120})
@click.version_option(VERSION, prog_name="stss")
def stss() -> None:
    """Space-time supersampling: frames in, twice the resolution and twice the frame rate out."""


def main() -> None:
    """Run the command; a mistake of the user is one line on standard error and status 2."""
    if installed("matplotlib"):
        # For Matplotlib, which colour-science imports and which else stores files beside other programs'. A failure here must not
        # stop a command that needs no device.
        with suppress(DeviceError):
            os.environ.setdefault("MPLCONFIGDIR", str(private("matplotlib")))
    run_guarded(stss, ArrayError, WeightsError)
