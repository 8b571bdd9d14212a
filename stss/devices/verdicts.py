# SPDX-License-Identifier: MIT
"""Decide whether a device may be trusted, by a self-test in a child process. The verdict is stored until something changes."""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import pyopencl as cl
from filelock import FileLock, Timeout

import stss_cl
import stss_ref
from conformance import tolerance
from stss.devices import child
from stss.devices.compilers import compilers, idle_processors
from stss.devices.trial import TRIALS
from stss.devices.watch import POLL, Watch
from stss.weights.file import REALTIME, SHIPPED
from stss_cl.device import program
from stss_cl.device.caches import is_temporary, private, read, store
from stss_cl.device.discovery import Properties
from stss_ground.errors import DeviceError
from stss_ground.terminal import printable
from stss_ground.version import VERSION

TIME_LIMIT = 240.0
"""Most processor time of a self-test, the greater part of it for compiling; seconds. ``$STSS_SELFTEST_SECONDS`` sets another limit.

A core of 2024 takes 20 s, a small board's ten times as long. Processor time, since a busy machine gives a process little of it.
"""
MOST_TIME = 86400.0
FAULTS = ("SIGSEGV", "SIGBUS", "SIGILL", "SIGFPE", "SIGABRT", "SIGTRAP", "SIGSYS")
"""Signals by which a driver's fault ends a process. Others come from outside: from a user, or from a system short of memory."""

COMMAND = (sys.executable, "-m", "stss.devices.selftest")

Tell = Callable[[str], None]

_OUTCOMES = ("passed", "failed", "hung", "crashed")
_MOST_BYTES = 1 << 16


@dataclass(frozen=True)
class Verdict:
    """The result of a self-test.

    Attributes:
        outcome: ``failed``: it disagrees, or there is no result; ``hung``: no answer within the time limit; ``crashed``: a signal ended
            the process.
        why: the reason in a few words; "" if it passed.
        gflops: speed, if it passed; 10**9 float32 operations a second.
        seconds: duration of the self-test.
        lasting: whether the device is the cause, so that another test would end in the same way; only such verdicts are stored.
    """

    outcome: Literal["passed", "failed", "hung", "crashed"]
    why: str = ""
    gflops: float = 0.0
    seconds: float = 0.0
    lasting: bool = True

    @property
    def passed(self) -> bool:
        """Whether the device agrees with the reference."""
        return self.outcome == "passed"

    def __str__(self) -> str:
        return f"{self.outcome}: {self.why}" if self.why else self.outcome


def verdict(
    name: str,
    handle: cl.Device,
    *,
    trial: str = REALTIME,
    again: bool = False,
    command: Sequence[str] = COMMAND,
    tell: Tell = lambda line: None,
) -> Verdict:
    """The stored verdict on a device, or the verdict of a self-test now; one process tests, and others that ask meanwhile wait for it.

    Args:
        name: the device's name by ``stss_cl.device.discovery.name_devices``.
        handle: the device of this name.
        trial: the weights to compute with, of `stss.devices.trial.TRIALS`.
        again: test even where a verdict is stored.
        command: the command that tests; the names of device and trial are appended.
        tell: called with a line if there is something to wait for.
    """
    if not again and (earlier := find_verdict(name, handle, trial=trial)):
        return earlier
    limit, path = _limit(), place_of(name, handle, trial=trial)
    with _alone(path.with_suffix(".lock"), lambda: tell(f"waiting for another process, which tests {name}")):
        if not again and (earlier := find_verdict(name, handle, trial=trial)):
            return earlier
        tell(
            f"self-test of {name}" if again else f"first start: building kernels for {name} and testing it, half a minute or more"
        )
        if is_temporary():
            tell("no writable cache folder: kernels are built for this process only; XDG_CACHE_HOME names another folder")
        # Only PoCL's compiler is known to use what other processes have in its cache.
        count = idle_processors() if command == COMMAND and Properties(handle).is_pocl_processor else 0
        with compilers(name, trial, count):
            new = run_selftest(name, command, limit, trial=trial)
        if count and not new.passed:  # a fault of the device is one without other processes, too
            new = run_selftest(name, command, limit, trial=trial)
        if again:  # a failed later trial runs again when it is needed
            for later in TRIALS[TRIALS.index(trial) + 1 :]:
                if (old := _read_verdict(name, handle, later)) and not old.passed:
                    place_of(name, handle, trial=later).unlink(missing_ok=True)
        if new.lasting:
            data = {"device": name, **asdict(new)}
            del data["lasting"]
            store(path, _with_checksum(path, json.dumps(data).encode()))
    return new


def find_verdict(name: str, handle: cl.Device, *, trial: str = REALTIME) -> Verdict | None:
    """The verdict stored for this device, its driver, this version of stss and these kernels; None if there is none.

    A device that passed a later trial has passed this one: it has these layers, and more.
    """
    own = _read_verdict(name, handle, trial)
    later = (_read_verdict(name, handle, more) for more in TRIALS[TRIALS.index(trial) + 1 :])
    return own or next((each for each in later if each is not None and each.passed), None)


def _read_verdict(name: str, handle: cl.Device, trial: str) -> Verdict | None:
    try:
        path = place_of(name, handle, trial=trial)
        content = read(path, _MOST_BYTES) or b""
        text = content.partition(b"\n")[2]
        if content != _with_checksum(path, text):
            return None
        data: Any = json.loads(text)
        if data.pop("device") != name or data["outcome"] not in _OUTCOMES or not isinstance(data["why"], str):
            return None
        numbers = data["gflops"], data["seconds"]
        if not all(type(number) in (int, float) and 0 <= number <= sys.float_info.max for number in numbers):
            return None
        return Verdict(**data) if len(data) == 4 else None  # outcome, why, gflops, seconds
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None


def _with_checksum(path: Path, text: bytes) -> bytes:
    """A verdict after a line with its checksum, which is valid only for this file's name: for this device, driver and version.

    No secret is in it: a program that can write to the folder can run code as its owner anyway, in a cached kernel.
    """
    return hashlib.sha256(path.name.encode() + b"\n" + text).hexdigest().encode() + b"\n" + text


def run_selftest(name: str, command: Sequence[str] = COMMAND, limit: float | None = None, *, trial: str = REALTIME) -> Verdict:
    """Test a device in a child process, which is killed with all that it started after ``limit`` seconds; None: `TIME_LIMIT`."""
    limit, start = _limit() if limit is None else limit, time.monotonic()
    test = child.start([*command, name, trial], subprocess.PIPE)
    watch = Watch(test.pid, limit)
    try:
        while True:
            try:
                out, log = test.communicate(timeout=POLL)
                break
            except subprocess.TimeoutExpired:
                if test.poll() is not None:
                    child.kill(test)  # a process that it left behind holds its output open
                elif why := watch.over():
                    return Verdict("hung", why, seconds=round(time.monotonic() - start, 3), lasting=False)
    finally:
        child.kill(test)
        for pipe in filter(None, (test.stdout, test.stderr)):
            pipe.close()
    return _read(test.returncode, out, log, round(time.monotonic() - start, 3))


@contextmanager
def _alone(path: Path, wait: Callable[[], None]) -> Generator[None]:
    """Hold the lock of this file, which the system releases when its process ends; ``wait`` is called if another process has it."""
    with ExitStack() as stack:
        # Some file systems have no locks, a full one no room: every process then tests for itself.
        with suppress(OSError, NotImplementedError):
            lock = FileLock(path)
            try:
                lock.acquire(blocking=False)
            except Timeout:
                wait()
                lock.acquire()
            stack.callback(lock.release)
        yield


def _limit() -> float:
    setting = os.environ.get("STSS_SELFTEST_SECONDS")
    try:
        limit = TIME_LIMIT if setting is None else float(setting)
    except ValueError:
        limit = 0.0
    if not 0 < limit <= MOST_TIME:
        raise DeviceError(f"STSS_SELFTEST_SECONDS: expected a number of seconds > 0, {MOST_TIME:g} at most, got {setting!r}")
    return limit


def _read(status: int, out: str, log: str, seconds: float) -> Verdict:
    last = printable((log.strip().splitlines() or [""])[-1].strip())
    if status < 0:
        name = _signal(-status)
        return Verdict("crashed", f"{name}: {last}" if last else name, seconds=seconds, lasting=name in FAULTS)
    try:
        result: Any = json.loads(out.strip().splitlines()[-1])  # a driver may have printed something before
        why, gflops = printable(str(result["why"])), float(result["gflops"])
        if not 0 <= gflops < math.inf:
            raise ValueError
    except (ValueError, TypeError, LookupError):
        return Verdict("failed", last or f"ended with status {status} and no result", seconds=seconds, lasting=False)
    return Verdict("failed" if why else "passed", why, gflops, seconds)


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def place_of(name: str, handle: cl.Device, *, trial: str) -> Path:
    """The file of a verdict: of a device, its driver, these sources and settings."""
    settings = {
        k: v
        for k, v in os.environ.items()
        if k.startswith(("POCL_", "CL_CONFIG_", "STSS_DEVICE_CLASS", "STSS_LINKER")) and k != "POCL_CACHE_DIR"
    }
    what = [name, handle.driver_version, handle.platform.version, VERSION, digest_of_sources(), sorted(settings.items()), trial]
    return private("verdicts") / f"{hashlib.sha256(json.dumps(what).encode()).hexdigest()[:32]}.json"


@lru_cache(1)
def digest_of_sources() -> str:
    """Digest of the kernels, of the host code that launches them, and of the reference that they are compared with."""
    digest = hashlib.sha256()
    for path in _judged_files():
        text = path.read_bytes()
        digest.update(f"{path.name} {len(text)} ".encode() + text)
    return digest.hexdigest()


def _judged_files() -> list[Path]:
    """All kernels and host sources, the reference, the bounds, the self-test and its weights."""
    host, reference = Path(stss_cl.__file__).parent, Path(stss_ref.__file__).parent
    files = [*program.KERNELS.rglob("*.cl*"), *host.rglob("*.py"), *host.rglob("*.toml"), *reference.rglob("*.py")]
    return [*sorted(files), Path(tolerance.__file__), *sorted(Path(__file__).parent.glob("*.py")), *SHIPPED.values()]
