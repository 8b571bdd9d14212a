# SPDX-License-Identifier: MIT
"""``stss gpu-report``: test and time everything on a GPU by one command, into one folder.

Each step is an ``stss`` or test command in its own session with its own time limit, so that a driver that hangs or ends the process
costs only that step, and none of its processes survives it. The page is written again after each step.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Literal

from rich.console import Console

from conformance.protocol.own_session import run_alone
from stss_cl.device.discovery import Properties, is_gpu, matching
from stss_ground.errors import InputError
from stss_ground.machine import cpu_model, versions
from stss_ground.output.write_whole import make_folder, write_named
from stss_ground.progress import show_steps
from stss_ground.version import VERSION

ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "pyopencl", "torch", "onnxruntime", "onnxruntime-gpu", "tensorrt")
TESTS = tuple(
    f"tests/cl/test_{n}.py"
    for n in ("device", "conv_gpu", "network", "image_stages", "frame", "output", "backend", "combinations", "stream")
)
"""Tests, in the order that shows a fault soonest; tests beyond the time limit do not run."""

OURS = "cl,cl-direct,cl-half,cl-host,cl-frame,cl-stream,cl-stream-ahead,cl-push"
PEERS = (
    "pytorch-cuda,pytorch-cuda-compiled,pytorch-cuda-float32,pytorch-cuda-float32-compiled,pytorch-cuda-tf32-compiled,"
    "onnxruntime-cuda,onnxruntime-tensorrt"
)

PATIENCE = 4
"""Factor of the time limits in a tiny report, since a processor takes longer for the kernels of GPUs."""

Outcome = Literal["passed", "failed", "over its limit", "skipped"]


@dataclass(frozen=True)
class Step:
    """One step.

    Attributes:
        name: names its log, too.
        command: None if it cannot run here, for ``reason``.
        limit: most seconds that it may take.
        reason: why there is no command.
    """

    name: str
    command: tuple[str, ...] | None
    limit: float
    reason: str = ""


@dataclass(frozen=True)
class StepResult:
    """The result of a step.

    Attributes:
        name: of the step.
        outcome: of ``Outcome``.
        seconds: it took.
        last_line: of its output, or why it was skipped; empty if it printed nothing.
    """

    name: str
    outcome: Outcome
    seconds: float
    last_line: str


def steps(folder: Path, device: str, *, tiny: bool) -> list[Step]:
    """All steps, in order: those that find faults come first, since figures of a faulty device mean nothing.

    Args:
        folder: the steps write their files there.
        device: full name of the device.
        tiny: take small sizes and counts, which only check that every step runs.
    """
    size, few, tests = ("64x48", "2", TESTS[:1]) if tiny else ("960x544", "20", TESTS)
    here, to = ("--device", device, "--size", size), folder.absolute()
    stss = sys.executable, "-m", "stss"
    return [
        Step("devices", (*stss, "devices", "--again"), 120),
        _driver(),
        Step(
            "tests",
            (sys.executable, "-m", "pytest", "-n4", "-p", "no:cacheprovider", *tests) if (ROOT / "tests").is_dir() else None,
            400,
            "the tests come with a checkout, not with the wheel",
        ),
        Step(
            "conform",
            (
                *(*stss, "conform", "--port", "stss.port:OpenCLPort", *(("--stages", "warp,rrm") if tiny else ())),
                *("--failures", f"{to / 'conform-failures'}", "--json", f"{to / 'conform.json'}"),
            ),
            240,
        ),
        Step(
            "bench",
            (
                *(*stss, "bench", *here, "--repeat", few, "--ours", OURS, "--peers", "" if tiny else PEERS),
                *("--json", f"{to / 'bench.json'}"),
            ),
            380,
        ),
        Step("launches", (*stss, "bench", "--launches", *here, "--repeat", few, "--ours", "cl,cl-half"), 60),
        Step("tune", (*stss, "tune", *here), 120),
        Step(
            "pareto",
            (*stss, "bench", "--pareto", *here, "--frames", "10", "--scenes", "object,pan"),
            150,
        ),
    ]


def _driver() -> Step:
    """Ask the driver's tool for the device's versions, clocks, and the clocks' limits."""
    tools = {
        "nvidia-smi": ("--query",),
        "rocm-smi": ("--showallinfo",),
        "clinfo": (),
    }
    for tool, options in tools.items():
        if path := shutil.which(tool):
            return Step("driver", (path, *options), 20)
    return Step("driver", None, 0, f"none of {', '.join(tools)} is here")


def gpu_report(folder: Path, device: str | None, *, tiny: bool, console: Console) -> bool:
    """Run every step.

    Args:
        folder: a new or an empty folder.
        device: part of the device's name; None: the first GPU, or else the first device.
        tiny: see `steps`.
        console: where progress is shown.

    Returns:
        Whether there is no fault.

    Raises:
        InputError: the folder is not empty.
        DeviceError: there is no such device.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: expected a new or an empty folder")
    fitting = matching(device if device is not None else os.environ.get("STSS_DEVICE"))
    name = next((each for each in fitting if is_gpu(fitting[each])), next(iter(fitting)))
    properties = Properties(fitting[name])
    machine = {
        "stss": VERSION,
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        "device": name,
        "treated as": properties.device_class,
        "driver": str(fitting[name].driver_version),
        "cpu": cpu_model(),
        "system": f"{platform.system()} {platform.machine()}",
        **versions(PACKAGES),
    }
    make_folder(folder)
    make_folder(folder / "logs")
    outcomes: list[StepResult] = []
    patience = PATIENCE if tiny else 1
    todo = steps(folder, name, tiny=tiny)
    with show_steps(console, len(todo)) as begin:
        for step in (replace(each, limit=patience * each.limit) for each in todo):
            begin(f"{step.name}: up to {step.limit:.0f} s")
            outcomes.append(_run(step, folder / "logs" / f"{step.name}.txt", name))
            _write(folder, machine, outcomes, tiny=tiny)
    return all(each.outcome in ("passed", "skipped") for each in outcomes)


def _run(step: Step, log: Path, device: str) -> StepResult:
    if step.command is None:
        return StepResult(step.name, "skipped", 0.0, step.reason)
    start = time.monotonic()
    with log.open("w+b", buffering=0) as out:
        env = {**os.environ, "STSS_DEVICE": device, "COLUMNS": "160"}
        ending = run_alone(step.command, out, out, step.limit, folder=ROOT, env=env)
    outcome: Outcome = "passed" if ending.status == 0 else "failed"
    if ending.status is None and not ending.has_talked:
        outcome = "over its limit"
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    return StepResult(step.name, outcome, round(time.monotonic() - start, 1), lines[-1] if lines else "")


def find_slower(path: Path) -> list[str]:
    """From the benchmark's JSON: contenders that failed, and peers of the same precision that are faster than the network."""
    if not path.exists():
        return []
    rows = json.loads(path.read_text(encoding="utf-8"))["sizes"][0]["rows"]
    lines = [f"{row['name']}: {_cell(row['fault'])}" for row in rows if row.get("fault") and not row["peer"]]
    ours = {row["details"].get("precision"): row for row in rows if row["name"] in ("cl", "cl-half") and not row.get("fault")}
    for row in rows:
        same = ours.get({"float16": "half"}.get(row["details"].get("precision"), row["details"].get("precision")))
        if row["peer"] and same and not row.get("fault") and row["minimum_ms"] < same["minimum_ms"]:
            lines.append(f"{row['name']} takes {row['minimum_ms']:.2f} ms, {same['name']} {same['minimum_ms']:.2f} ms")
    return lines


def _table(*rows: Iterable[object]) -> str:
    """The first row has the titles."""
    titles, *lines = (" | ".join(str(cell) for cell in row) for row in rows)
    return "\n".join(f"| {line} |" for line in (titles, " | ".join(["---"] * len(titles.split("|"))), *lines))


def _cell(text: str) -> str:
    return text.replace("|", "/")[:200]


def _write(folder: Path, machine: dict[str, str], outcomes: Sequence[StepResult], *, tiny: bool) -> None:
    """The page: faults, steps and machine."""
    wrong = [
        *(
            f"**{each.name}** {each.outcome}, see `logs/{each.name}.txt`: {_cell(each.last_line) or 'no output'}"
            for each in outcomes
            if each.outcome not in ("passed", "skipped")
        ),
        *find_slower(folder / "bench.json"),
    ]
    parts = [
        f"# {machine['device']}\n",
        *(["Small sizes, which show that every step runs. **The figures mean nothing.**\n"] if tiny else []),
        "## Faults\n",
        "\n".join(f"- {line}" for line in wrong) or "No faults found.",
        "\n## Steps\n",
        _table(("step", "outcome", "s", "last line"), *((s.name, s.outcome, s.seconds, _cell(s.last_line)) for s in outcomes)),
        "\n## Machine\n",
        _table(("property", "value"), *machine.items()),
    ]
    write_named(folder / "README.md", "\n".join(parts) + "\n")
