# SPDX-License-Identifier: MIT
"""This machine and the versions installed on it, as reports state them."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
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


MINE, MOUNT = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
"""Where Linux says which control groups a process is in, and where these are, as containers and farms set them."""


processes = 1
"""Processes of a run that work side by side on this machine; a worker of several sets it."""


def available_threads() -> int:
    """Cores for this process: those that it may run on, or as many as its container has time for, rounded up, if these are fewer.

    Processes of a run that work side by side share them.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, container_cores() or cores) // processes)


def container_cores(mine: Path = MINE, mount: Path = MOUNT) -> int | None:
    """Cores whose time this process may take by its control group and those above, rounded up; None: no limit."""
    shares: list[int] = []
    for quota, period in _limits("cpu", ("cpu.cfs_quota_us", "cpu.cfs_period_us"), "cpu.max", mine, mount):
        if quota > 0 and period > 0:  # version 1 has -1 for no limit
            shares.append(-(-quota // period))
    return min(shares, default=None)


def container_memory(mine: Path = MINE, mount: Path = MOUNT) -> int | None:
    """Bytes that this process may take by its control group and those above; None: no limit."""
    return min((limit for (limit,) in _limits("memory", ("memory.limit_in_bytes",), "memory.max", mine, mount)), default=None)


def _limits(controller: str, first: tuple[str, ...], second: str, mine: Path, mount: Path) -> Iterator[list[int]]:
    """The numbers of each group that has them: of version ``first`` in files of one number each, of the ``second`` in one file."""
    with suppress(OSError, ValueError):
        for line in mine.read_text(encoding="utf-8").splitlines():
            _, controllers, group = line.split(":", 2)  # version 2 has one line, without controllers
            if controllers and controller not in controllers.split(","):
                continue
            top, names = (mount / controller, first) if controllers else (mount, (second,))
            own = top / group.lstrip("/")
            for folder in (each for each in (own, *own.parents) if each.is_relative_to(top)):
                with suppress(OSError, ValueError):  # not there in a container, or "max"
                    yield [int(number) for name in names for number in (folder / name).read_text(encoding="utf-8").split()]


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
