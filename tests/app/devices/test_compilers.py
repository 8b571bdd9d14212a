"""Kernels are compiled on idle processors while the device is tested."""

import os
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pyopencl as cl
import pytest

from stss.devices import child, verdicts
from stss.devices import compilers as of_compilers
from stss.devices.compilers import COMMAND, MOST, compilers, idle_processors
from stss.devices.verdicts import Verdict, verdict
from stss.weights.file import REALTIME

NETWORK = {"winograd", "winograd_image", "prepare_newest", "arrive", "upsample_corners"}


def compiled(home):
    """The kernels that PoCL has compiled into this cache, by file and name."""
    return {(path, path.parents[1].name) for path in Path(home).rglob("*.so")}


@pytest.mark.thorough
def test_the_self_test_finds_the_kernels(device, tmp_path, monkeypatch):
    """Those of the network and of frames, whatever the share that one process begins with; the rest are the self-test's own."""
    if not device.is_pocl_processor:
        pytest.skip("not PoCL on a processor")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for command in (
        (*COMMAND, device.name, REALTIME, "0.4"),
        (sys.executable, "-m", "stss.devices.selftest", device.name, REALTIME),
    ):
        before = compiled(tmp_path)
        test = child.start(command, subprocess.PIPE)
        _, log = test.communicate()
        assert not test.returncode, log
        new = {name for _, name in compiled(tmp_path) - before}
        assert new >= NETWORK if not before else not new & NETWORK


def test_they_end_with_the_self_test(tmp_path):
    """Each begins at another share, the last one at the end."""
    note = (
        f"import os, sys, time; open(os.path.join({str(tmp_path)!r}, sys.argv[3]), 'w').write(str(os.getpid())); time.sleep(60)"
    )
    with compilers("A: b", "every", 2, (sys.executable, "-c", note)):
        while len(files := [path for path in tmp_path.iterdir() if path.read_text()]) < 2:
            time.sleep(0.02)
    assert {path.name for path in files} == {"0.5", "1.0"}
    for path in files:
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.read_text()), 0)


def test_busy_processors_compile_nothing(monkeypatch):
    monkeypatch.setattr(of_compilers, "available_threads", lambda: 8)
    for running, idle in ((1, 3), (6, 2), (8, 0), (99, 0)):
        monkeypatch.setattr(Path, "read_text", lambda self, running=running: f"0.50 1.00 2.00 {running}/300 1234\n")
        assert idle_processors() == idle
    monkeypatch.setattr(of_compilers, "available_threads", lambda: 64)
    assert idle_processors() == 0
    monkeypatch.setattr(Path, "read_text", lambda self: "nothing that is known")
    assert idle_processors() == MOST


@pytest.mark.parametrize(("count", "outcomes"), [(1, ["failed", "passed"]), (1, ["passed"]), (0, ["failed"])])
def test_a_fault_counts_if_the_device_has_it_alone(monkeypatch, tmp_path, count, outcomes):
    """Other processes may disturb a driver; where there were none, nothing is tested twice."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(verdicts, "idle_processors", lambda: count)
    monkeypatch.setattr(verdicts, "compilers", lambda *_: nullcontext())
    left = list(outcomes)
    monkeypatch.setattr(verdicts, "run_selftest", lambda *_, **__: Verdict(left.pop(0)))
    handle = SimpleNamespace(
        platform=SimpleNamespace(name="Portable Computing Language", version="OpenCL 3.0"), name="cpu", version="", driver_version="7",
        type=cl.device_type.CPU,
    )  # fmt: skip
    assert verdict("Portable Computing Language: cpu", handle).outcome == outcomes[-1]
    assert not left
