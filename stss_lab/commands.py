# SPDX-License-Identifier: MIT
"""The commands of the laboratory, which ``stss`` finds by the entry point ``stss.commands``."""

from __future__ import annotations

from stss_ground.commands import Sections

SECTIONS: Sections = {
    "Compare": {
        "methods": ("stss_lab.command_methods:methods_command", "Compare the network with other methods."),
    },
    "Devices": {"tune": ("stss_lab.command_tune:tune", "Find the fastest tile sizes for a device.")},
    "Ports": {"export": ("stss_lab.command_bench:export", "Write the network as ONNX.")},
    "Measure": {
        "bench": ("stss_lab.command_bench:bench_command", "Time the network beside other engines."),
        "stress": ("stss_lab.command_stress:stress_command", "Measure errors on hard inputs."),
        "gpu-report": ("stss_lab.command_bench:gpu_report_command", "Test, judge and time this machine's GPU."),
    },
}
"""Section of ``stss --help`` -> command -> its module and function, and its purpose."""
