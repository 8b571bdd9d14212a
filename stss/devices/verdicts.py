# SPDX-License-Identifier: MIT
"""Whether a device may be trusted: its self-test, run in a child process with a time limit, and kept until something changes."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import pyopencl as cl

import stss_cl
from stss.version import VERSION
from stss_cl.device import program
from stss_cl.device.caches import private
from stss_cl.errors import DeviceError

TIME_LIMIT = 60.0
"""Seconds a self-test may take, most of which goes into compiling; ``$STSS_SELFTEST_SECONDS`` sets another limit."""

COMMAND = (sys.executable, "-m", "stss.devices.selftest")

_PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class Verdict:
    """What came of a self-test.

    Attributes:
        outcome: ``hung``: no answer within the time limit; ``crashed``: the process ended by a signal.
        why: a few words, unless it passed.
        gflops: speed, if it passed; 10**9 float32 operations a second.
        seconds: what the self-test took.
    """

    outcome: Literal["passed", "failed", "hung", "crashed"]
    why: str = ""
    gflops: float = 0.0
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether the device agrees with the reference."""
        return self.outcome == "passed"

    def __str__(self) -> str:
        return f"{self.outcome}: {self.why}" if self.why else self.outcome


def verdict(name: str, handle: cl.Device, *, again: bool = False, command: Sequence[str] = COMMAND) -> Verdict:
    """The kept verdict on a device, or that of a self-test now.

    Args:
        name: of ``stss_cl.device.discovery.named``.
        handle: the device of this name.
        again: test, whatever is kept.
        command: what tests the device whose name is appended.
    """
    if not again and (kept := known(name, handle)):
        return kept
    found = run_selftest(name, command)
    path = _path(name, handle)
    beside = path.with_suffix(f".{os.getpid()}")
    beside.write_text(json.dumps({"device": name, **asdict(found)}), encoding="utf-8")
    beside.replace(path)
    return found


def known(name: str, handle: cl.Device) -> Verdict | None:
    """The verdict kept for this device, its driver, this version of ours and these kernels; None: there is none."""
    try:
        kept = json.loads(_path(name, handle).read_text(encoding="utf-8"))
        del kept["device"]
        return Verdict(**kept)
    except (OSError, ValueError, TypeError, KeyError):
        return None


def run_selftest(name: str, command: Sequence[str] = COMMAND) -> Verdict:
    """Test a device in a child process, which is killed with all its threads after the time limit."""
    limit, start = _limit(), time.perf_counter()
    # Beside our packages, since -m takes modules from the working directory first, and that is the user's.
    child = subprocess.Popen(
        [*command, name],
        cwd=_PACKAGE.parent,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    try:
        out, log = child.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        return Verdict("hung", f"no answer within {limit:g} s", seconds=limit)
    finally:
        _kill(child)
    return _read(child.returncode, out, log, round(time.perf_counter() - start, 3))


def _limit() -> float:
    named = os.environ.get("STSS_SELFTEST_SECONDS")
    try:
        limit = TIME_LIMIT if named is None else float(named)
    except ValueError:
        limit = 0.0
    if not limit > 0:
        raise DeviceError(f"STSS_SELFTEST_SECONDS: expected a number of seconds > 0, got {named!r}")
    return limit


def _read(status: int, out: str, log: str, seconds: float) -> Verdict:
    last = (log.strip().splitlines() or [""])[-1].strip()
    if status < 0:
        return Verdict("crashed", f"{_signal(-status)}: {last}" if last else _signal(-status), seconds=seconds)
    try:
        result: Any = json.loads(out.strip().splitlines()[-1])  # a driver may have printed something before
        why, gflops = str(result["why"]), float(result["gflops"])
    except (ValueError, TypeError, LookupError):
        return Verdict("failed", last or f"ended with status {status} and no result", seconds=seconds)
    return Verdict("failed" if why else "passed", why, gflops, seconds)


def _kill(child: subprocess.Popen[str]) -> None:
    """End the child and what it started; a no-op where it ended by itself."""
    if child.poll() is not None:
        return
    if hasattr(os, "killpg"):
        os.killpg(child.pid, signal.SIGKILL)
    else:
        child.kill()
    with suppress(subprocess.TimeoutExpired):  # one that the driver holds inside the kernel cannot be ended
        child.communicate(timeout=5)


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _path(name: str, handle: cl.Device) -> Path:
    settings = {k: v for k, v in os.environ.items() if k.startswith(("POCL_", "CL_CONFIG_")) and k != "POCL_CACHE_DIR"}
    what = [name, handle.driver_version, handle.platform.version, VERSION, _sources(), sorted(settings.items())]
    return private("verdicts") / f"{hashlib.sha256(json.dumps(what).encode()).hexdigest()[:32]}.json"


@lru_cache(1)
def _sources() -> str:
    """Digest of what runs on a device and of what starts it."""
    host = Path(stss_cl.__file__).parent
    files = [*program.KERNELS.glob("*.cl*"), *host.rglob("*.py"), *host.rglob("*.toml"), Path(__file__).with_name("selftest.py")]
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(path.read_bytes())
    return digest.hexdigest()
