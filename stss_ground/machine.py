# SPDX-License-Identifier: MIT
"""This machine and the versions installed on it, as reports state them."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from stss_ground.version import VERSION


def cpu_model() -> str:
    """The CPU's name, as the system reports it."""
    return _cpuinfo("model name") or platform.processor() or "unknown"


def cpu_flags() -> frozenset[str]:
    """Abilities of the CPU, by Linux's names such as ``avx512f``; empty where the system does not list them."""
    return frozenset(_cpuinfo("flags").split())


def _cpuinfo(field: str) -> str:
    """The entry of the first core; empty if there is none."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith(field))
    except (OSError, StopIteration):
        return ""


def available_threads() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions(names: tuple[str, ...]) -> dict[str, str]:
    """The version of each distribution in ``names`` that is installed."""
    installed: dict[str, str] = {}
    for name in names:
        try:
            installed[name] = version(name)
        except PackageNotFoundError:
            continue
    return installed


def conditions(packages: tuple[str, ...]) -> dict[str, Any]:
    """The beginning of a JSON report: versions and the machine, without names of hosts, users or folders."""
    return {
        "stss": VERSION,
        "machine": {"cpu": cpu_model(), "system": platform.system(), "architecture": platform.machine()},
        "packages": {"python": platform.python_version(), **versions(packages)},
    }
