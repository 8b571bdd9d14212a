"""The choice of a device, and the verdict of its self-test: fake devices and fake self-tests, and the real ones once."""

import io
import json
import os
import shutil
import signal
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest
from rich.console import Console

from stss.devices import selection as devices
from stss.devices import selftest, verdicts
from stss.devices.selection import choose
from stss.devices.trial import EVERY
from stss.devices.verdicts import Verdict, find_verdict, run_selftest, verdict
from stss.devices.watch import IDLE, POLL, Watch
from stss.frames.backends import open_backend
from stss.weights.file import REALTIME
from stss_cl.device import amx, caches, program
from stss_cl.device import discovery as cl_device
from stss_cl.device.discovery import CHOICES, open_device
from stss_ground.errors import DeviceError
from stss_ref.weights import random
from tests.hostile.cases import runs

PASS = {"why": "", "gflops": 5.0}
NAME = "A: cpu"
HANDLE = SimpleNamespace(driver_version="1", platform=SimpleNamespace(version="OpenCL 1.2"))


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("STSS_DEVICE", "STSS_TRUST_DEVICE", "STSS_SELFTEST_SECONDS"):
        monkeypatch.delenv(name, raising=False)


def fake(platform, name, kind=cl.device_type.CPU, driver="1", target="znver3"):
    return SimpleNamespace(
        platform=SimpleNamespace(name=platform, version="OpenCL 1.2"),
        version=f"OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-{target}",
        name=name,
        type=kind,
        driver_version=driver,
        global_mem_size=2**34,
        extensions="cl_khr_fp16",
    )


GPU, CPU = cl.device_type.GPU, cl.device_type.CPU


@pytest.fixture
def machine(monkeypatch):
    """``machine({name: (kind, verdict)})``: a machine with these devices; verdicts are not stored, and each request is noted."""

    def make(table):
        handles = {name: fake(*name.split(": "), kind) for name, (kind, _) in table.items()}
        monkeypatch.setattr(cl_device, "find_devices", lambda: sorted(handles.values(), key=cl_device.full_name))
        monkeypatch.setattr(devices, "open_handle", cl_device.full_name)
        tested = []

        def answer(name, handle, *, trial=REALTIME, again=False, tell=None):
            tested.append(name if trial == REALTIME else f"{name} {trial}")
            return table[name][1]

        monkeypatch.setattr(devices, "verdict", answer)
        return tested

    return make


def passed(gflops):
    return Verdict("passed", gflops=gflops)


def test_a_graphics_processor_goes_before_the_fastest_processor_unless_it_fails(machine):
    tested = machine({"A: cpu": (CPU, passed(100)), "B: gpu": (GPU, passed(1)), "C: gpu": (GPU, passed(2))})
    assert choose() == "C: gpu"
    assert tested == ["B: gpu", "C: gpu"]
    hung = Verdict("hung", "no answer within 60 s")
    machine({"A: slow": (CPU, passed(1)), "B: fast": (CPU, passed(3)), "C: gpu": (GPU, hung)})
    lines = []
    assert choose(None, lines.append) == "B: fast"
    assert lines[-1] == "not used: C: gpu hung: no answer within 60 s"
    with pytest.raises(DeviceError, match=r"^device 'radeon': expected part of one of A: slow, B: fast, C: gpu$"):
        choose("radeon")


def test_without_a_device_a_variable_that_hides_it_is_named(machine, monkeypatch):
    machine({})
    for name in CHOICES:
        monkeypatch.delenv(name, raising=False)
    for ask in (choose, devices.rows):
        with pytest.raises(DeviceError, match=r"^no OpenCL device: pip install"):
            ask()
    monkeypatch.setenv("POCL_DEVICES", "cuda")
    with pytest.raises(DeviceError, match=r"^no OpenCL device: POCL_DEVICES=cuda may hide it"):
        choose()
    monkeypatch.setenv("POCL_CACHE_DIR", "/proc/none")  # PoCL, which cannot write there, has no device
    with pytest.raises(DeviceError, match=r"^no OpenCL device: POCL_DEVICES=cuda and POCL_CACHE_DIR=/proc/none may hide it"):
        choose()


def test_a_named_device_is_taken_however_slow(machine, monkeypatch):
    table = {"A: cpu": (CPU, passed(1)), "B: gpu": (GPU, passed(2))}
    tested = machine(table)
    assert choose("a: CPU") == "A: cpu"
    assert tested == ["A: cpu"]
    monkeypatch.setenv("STSS_DEVICE", "A:")
    assert choose() == "A: cpu"
    assert choose("gpu") == "B: gpu"


@pytest.mark.parametrize(("weights", "trial"), [("realtime", ""), ("antialiased", ""), ("bilinear", ""), (random(0), " every")])
def test_what_is_tested_has_the_layers_that_weights_need(machine, weights, trial):
    """And no others, since these would take longest to compile."""
    tested = machine({"A: cpu": (CPU, Verdict("failed", "x"))})
    with pytest.raises(DeviceError, match="A: cpu failed: x"):
        open_backend("cl", weights)
    assert tested == [f"A: cpu{trial}"]


def test_a_named_device_that_failed_is_refused_unless_trusted(machine, monkeypatch):
    machine({"A: cpu": (CPU, passed(1)), "B: gpu": (GPU, Verdict("failed", "exp: off by 90 ulp"))})
    with pytest.raises(DeviceError) as error:
        choose("gpu")
    assert str(error.value) == (
        "self-test: B: gpu failed: exp: off by 90 ulp: stss devices --again tests again, STSS_TRUST_DEVICE=1 uses a device without a test"
    )
    monkeypatch.setenv("STSS_TRUST_DEVICE", "1")
    assert choose("gpu") == "B: gpu"


def test_the_table_has_every_device_the_best_first(machine, monkeypatch):
    monkeypatch.setattr(amx, "missing", lambda device: "" if device.kind == "CPU" else "no processor")
    machine({"A: wrong": (CPU, Verdict("failed", "x")), "B: cpu": (CPU, passed(7)), "C: gpu": (GPU, passed(1))})
    rows = devices.rows()
    assert [row.name for row in rows] == ["C: gpu", "B: cpu", "A: wrong"]
    out = io.StringIO()
    devices.print_rows(rows, Console(file=out, width=120))
    table = [line.split() for line in out.getvalue().splitlines()]
    assert table[2] == ["B:", "cpu", "CPU", "1", "znver3", "16.0", "GiB", "yes", "AMX", "passed", "(7", "GFLOP/s)"]
    assert table[3][-2:] == ["failed:", "x"]
    data = json.loads(devices.to_json(rows))
    assert data[2]["verdict"]["why"] == "x"
    assert [row["bfloat16"] for row in data] == ["emulated", "AMX", "AMX"]
    assert data[0]["memory"] == 2**34


@pytest.mark.parametrize(
    ("target", "flags", "words"),
    [
        ("znver3", {"avx2", "avx512f"}, "AVX-512"),
        ("znver3", {"avx2"}, None),
        ("some-new-name", {"avx2", "avx512f"}, None),
    ],
)
@pytest.mark.parametrize("kind", [CPU, GPU])
def test_what_a_processor_has_and_the_compiler_does_not_use_is_said(monkeypatch, target, flags, words, kind):
    monkeypatch.setattr(devices, "cpu_flags", lambda: frozenset(flags))
    handle = fake("P", "one", kind, target=target)
    monkeypatch.setattr(cl_device, "find_devices", lambda: [handle])
    monkeypatch.setattr(devices, "verdict", lambda *_, **__: passed(1))
    out = io.StringIO()
    rows = devices.rows()
    devices.print_rows(rows, Console(file=out, width=60))
    line = f"P: one: kernels are compiled for {target} and do not use this processor's {words}; another runtime may know it: pip install "
    assert (line in out.getvalue()) == (words is not None and kind == CPU)
    assert rows[0].target == target


# The child process


def child(text):
    return (sys.executable, "-c", "import os, sys, json, time\n" + text)


def answer(result):
    return child(f"print('a driver says hello'); print({json.dumps(json.dumps(result))})")


NO_PASS = [
    # the child's action, the message
    ("""print('{"why": "exp: off by 90 ulp", "gflops": 0}')""", "failed: exp: off by 90 ulp"),
    ("print(json.dumps({'why': str(sys.argv[1:]), 'gflops': 0}))", "failed: ['A: b #2', 'realtime']"),
    ("raise ImportError('no numpy')", "failed: ImportError: no numpy"),
    ("sys.exit(3)", "failed: ended with status 3 and no result"),
    ("print('[]')", "failed: ended with status 0 and no result"),
    ("print('llvm: out', file=sys.stderr, flush=True); os.kill(os.getpid(), 11)", "crashed: SIGSEGV: llvm: out"),
    ("while True: pass", "hung: no answer within 1 s of processor time"),
    ("time.sleep(60)", "hung: no answer, and idle for 1 s"),
    ("os.fork()\nwhile os.getpid() % 1 == 0: pass", "hung: no answer within 1 s of processor time"),
]


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="this system does not tell processor time")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize(("text", "words"), NO_PASS)
def test_what_is_no_pass_says_why(monkeypatch, text, words):
    monkeypatch.setenv("STSS_SELFTEST_SECONDS", "1")
    assert str(run_selftest("A: b #2", child(text))) == words


@pytest.mark.parametrize("limit", ["soon", "0", "nan", "86401"])
def test_a_wrong_time_limit_is_the_users_mistake(monkeypatch, limit):
    monkeypatch.setenv("STSS_SELFTEST_SECONDS", limit)
    with pytest.raises(DeviceError, match=r"^STSS_SELFTEST_SECONDS: expected a number of seconds > 0, 86400 at most, got"):
        run_selftest("any", answer(PASS))


# The kept verdict


NEVER = child("raise SystemExit('a kept verdict needs no child')")


def test_a_verdict_is_kept_until_told_otherwise():
    handle = fake("A", "cpu")
    assert find_verdict("A: cpu", handle) is None
    first = verdict("A: cpu", handle, command=answer(PASS))
    assert verdict("A: cpu", handle, command=NEVER) == first == find_verdict("A: cpu", handle)
    assert verdict("A: cpu", handle, again=True, command=answer({"why": "x", "gflops": 0})).why == "x"
    assert verdict("A: cpu", handle, command=NEVER).why == "x"
    on_all = verdict("A: cpu", handle, trial=EVERY, command=child("print(json.dumps({'why': sys.argv[2], 'gflops': 0}))"))
    assert on_all.why == EVERY
    assert verdict("A: cpu", handle, trial=EVERY, command=NEVER) == on_all != find_verdict("A: cpu", handle)


def test_again_forgets_what_later_trials_ended_with():
    """``stss devices --again`` is what a refusal names; it tests with the first trial's weights alone."""
    handle = fake("A", "cpu")
    verdict("A: cpu", handle, trial=EVERY, command=answer({"why": "x", "gflops": 0}))
    verdict("A: cpu", handle, again=True, command=answer(PASS))
    assert find_verdict("A: cpu", handle, trial=EVERY) is None


def test_a_device_that_passed_with_more_layers_is_not_tested_with_fewer():
    handle = fake("A", "cpu")
    verdict("A: cpu", handle, trial=EVERY, command=answer({"why": "x", "gflops": 0}))
    assert verdict("A: cpu", handle, command=answer(PASS)).passed
    more = verdict("B: cpu", handle, trial=EVERY, command=answer(PASS))
    assert verdict("B: cpu", handle, command=NEVER) == more


def test_a_verdict_lapses_when_anything_changes(monkeypatch):
    handle = fake("A", "cpu")
    verdict("A: cpu", handle, command=answer(PASS))
    assert find_verdict("A: cpu #2", handle) is None
    assert find_verdict("A: cpu", fake("A", "cpu", driver="2")) is None
    for change in (
        lambda m: m.setattr(verdicts, "VERSION", "0"),
        lambda m: m.setattr(verdicts, "digest_of_sources", lambda: "others"),
        lambda m: m.setenv("POCL_WORK_GROUP_METHOD", "cbs"),
        lambda m: m.setenv("STSS_DEVICE_CLASS", "gpu"),
    ):
        with monkeypatch.context() as changed:
            change(changed)
            assert find_verdict("A: cpu", handle) is None
    assert find_verdict("A: cpu", handle)


@pytest.mark.parametrize("edit", [(b"failed", b"passed"), (b'"why": "x"', b'"why": ""'), (b"2.0", b"9.0"), (b"}", b" }")])
def test_an_edited_verdict_is_ignored(edit):
    """For any change in it; the verdict of another device under this one's name is ignored, too."""
    handle = fake("A", "cpu")
    verdict("A: cpu", handle, command=answer({"why": "x", "gflops": 2.0}))
    (path,) = caches.private("verdicts").glob("*.json")
    before = path.read_bytes()
    path.write_bytes(before.replace(*edit))
    assert path.read_bytes() != before
    assert find_verdict("A: cpu", handle) is None
    path.write_bytes(before)
    assert find_verdict("A: cpu", handle).why == "x"
    newer = fake("A", "cpu", driver="2")
    path.rename(verdicts.place_of("A: cpu", newer, trial=REALTIME))
    assert find_verdict("A: cpu", newer) is None


# A busy machine


ANSWER = f"print({json.dumps(json.dumps(PASS))}, flush=True)\n"


@pytest.mark.thorough
def test_a_slow_clock_is_no_hang(monkeypatch):
    """Three times the limit on the clock, a fraction of it on the processor: as for a self-test on a busy machine."""
    monkeypatch.setenv("STSS_SELFTEST_SECONDS", "1")
    busy = "for _ in range(30):\n    end = time.process_time() + 0.01\n    while time.process_time() < end: pass\n    time.sleep(0.09)\n"
    got = run_selftest(NAME, child(busy + ANSWER))
    assert got.passed, got
    assert got.seconds > 2.7


def test_a_pause_of_all_processes_is_no_hang():
    """A suspended job, a paused container: the clock has gone on for an hour, and neither test nor watch has run."""
    clock = SimpleNamespace(now=0.0)
    watch, polls = Watch(1, verdicts.TIME_LIMIT, lambda: clock.now, lambda session: 7.0), int(IDLE / POLL)
    assert not watch.over()
    clock.now += 3600
    assert not watch.over()
    for _ in range(polls):
        clock.now += POLL
        reason = watch.over()
    assert reason == "no answer, and idle for 60 s"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_what_a_self_test_leaves_behind_ends_with_it(tmp_path):
    """It holds the output open, so the test would wait for it."""
    pid = tmp_path / "pid"
    program = f"if os.fork() == 0:\n    open({str(pid)!r}, 'w').write(str(os.getpid()))\n    time.sleep(100)\n"
    wait = f"while not os.path.exists({str(pid)!r}) or not open({str(pid)!r}).read(): time.sleep(0.01)\n"
    got = run_selftest(NAME, child(program + wait + ANSWER))
    assert got.passed
    assert got.seconds < 50
    deadline = time.monotonic() + 20  # a signal is on its way for a moment
    while runs(pid.read_text()) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not runs(pid.read_text())


NOT_THE_DEVICE = {  # an end of the self-test that does not depend on the device
    "hung": "time.sleep(60)",
    "out of memory": f"os.kill(os.getpid(), {int(signal.SIGKILL)})",
    "ended from outside": f"os.kill(os.getpid(), {int(signal.SIGTERM)})",
    "no result": "raise MemoryError",
    "a speed that is none": """print('{"why": "", "gflops": NaN}')""",
}


@pytest.mark.parametrize("kind", NOT_THE_DEVICE)
def test_what_does_not_last_is_not_kept(monkeypatch, kind):
    monkeypatch.setenv("STSS_SELFTEST_SECONDS", "1")
    first = verdict(NAME, HANDLE, command=child(NOT_THE_DEVICE[kind]))
    assert not first.passed
    assert find_verdict(NAME, HANDLE) is None
    assert verdict(NAME, HANDLE, command=child(ANSWER)).passed
    verdict("A fault of the driver", HANDLE, command=child(f"os.kill(os.getpid(), {int(signal.SIGSEGV)})"))
    assert find_verdict("A fault of the driver", HANDLE).outcome == "crashed"


@pytest.mark.skipif(os.name == "nt", reason="the test holds a lock by flock")
def test_one_process_tests_while_others_wait(tmp_path):
    """All get its verdict: none of several first starts at once is refused."""
    mark, go, waiting = tmp_path / "begun", tmp_path / "go", threading.Barrier(4, timeout=60)
    slow = child(f"open({str(mark)!r}, 'a').write('x')\n" + f"while not os.path.exists({str(go)!r}): time.sleep(0.01)\n" + ANSWER)
    got, lines = [], []

    def start():
        def tell(line):
            lines.append(line)
            if line.startswith("waiting"):
                waiting.wait()

        got.append(verdict(NAME, HANDLE, command=slow, tell=tell))

    starts = [threading.Thread(target=start) for _ in range(4)]
    for each in starts:
        each.start()
    waiting.wait()  # three of four wait
    go.touch()
    for each in starts:
        each.join(60)
    assert [each.outcome for each in got] == ["passed"] * 4
    assert mark.read_text() == "x"
    assert sorted(line.split()[0] for line in lines) == ["first", "waiting", "waiting", "waiting"]


# A real device


@pytest.mark.parametrize("check", [*selftest.CHECKS, selftest.frames], ids=lambda check: check.__name__)
def test_the_device_here_passes(device, check):
    check(device, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("kernel", "wrong", "check", "why"),
    [
        ("a[i] * b[i] + c[i]", "fma(a[i], b[i], c[i])", "arithmetic", r"a \* b \+ c: \d+ of 1003 wrong"),
        ("exp(c[i])", "exp2(c[i] * 1.44269504f)", "arithmetic", "exp: off by .* ulp, 3.0 allowed"),
        ("vload8(i, in + 1)", "vload8(i, in)", "vectors", "vload8: "),
        ("atomic_min(", "atomic_max(", "nearest", "atomic_min: 50 of 50 wrong"),
        ("k < steps", "k < min(steps, 65535)", "turns", "turns of a loop: 8 of 8 wrong"),
        ("part[i] += part[i + half_of]", "part[i] += part[i]", "groups", "local memory and barrier: "),
        ("share = lower ? 0.25f", "share = lower ? 0.26f", "output", "carried: "),
        ("i < 2;", "i < 1;", "output", "sRGB: .* times the allowed error"),
    ],
)
def test_a_device_that_computes_wrongly_is_found_out(device, monkeypatch, tmp_path, kernel, wrong, check, why):
    """Planted faults: the kernel does what a bad driver might."""
    copy = shutil.copytree(program.KERNELS, tmp_path / "kernels")
    file = copy / ("output.cl" if check == "output" else "selftest.cl")
    text = file.read_text()
    assert kernel in text
    file.write_text(text.replace(kernel, wrong))
    monkeypatch.setattr(program, "KERNELS", copy)
    with pytest.raises(selftest.MismatchError, match=why):
        getattr(selftest, check)(open_device(device.name), np.random.default_rng(0))
