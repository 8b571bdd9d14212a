# SPDX-License-Identifier: MIT
"""This machine and the versions installed on it, as reports state them."""

from __future__ import annotations

import os
import platform
from contextlib import suppress
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


def container_memory(mine: Path = Path("/proc/self/cgroup"), mount: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Bytes that this process may take by its control group and those above, as containers and farms set them; None: no limit."""
    limits: list[int] = []
    with suppress(OSError):
        for line in mine.read_text(encoding="utf-8").splitlines():
            _, controllers, group = line.split(":", 2)  # version 2 has one line, without controllers
            if controllers and "memory" not in controllers.split(","):
                continue
            top, name = (mount / "memory", "memory.limit_in_bytes") if controllers else (mount, "memory.max")
            own = top / group.lstrip("/")
            for folder in (each for each in (own, *own.parents) if each.is_relative_to(top)):
                with suppress(OSError, ValueError):  # not there in a container, or "max"
                    limits.append(int((folder / name).read_text(encoding="utf-8")))
    return min(limits, default=None)


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
