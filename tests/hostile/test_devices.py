"""Caches, self-tests and first starts: no code of others is run, and a busy machine is not taken for a broken one."""

import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from collections import namedtuple
from pathlib import Path
from types import SimpleNamespace

import pyopencl as cl
import pytest

import stss_cl
from stss.demo import write_demo_sequence
from stss.devices import verdicts
from stss.devices.verdicts import known, run_selftest, verdict
from stss_cl.device import caches, program
from stss_cl.device.discovery import DeviceError, found, open_device
from tests.hostile.cases import refused, stss

PASSED = '{"why": "", "gflops": 5.0}'
HANDLE = SimpleNamespace(driver_version="1", platform=SimpleNamespace(version="OpenCL 1.2"))
NAME = "A: cpu"
NOBODY = 65534

COMPUTE = """
import numpy as np
from stss.devices import selftest
from stss_cl.device.discovery import open_device
import pyopencl as cl
selftest.groups(open_device(), np.random.default_rng(0))
print("computed")
"""
# As PyOpenCL does by itself.
SHARED = "import pyopencl.invoker\n" + COMPUTE.replace("selftest.groups", "cl._PYOPENCL_NO_CACHE = False\nselftest.groups")


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("STSS_DEVICE", "STSS_TRUST_DEVICE", "STSS_SELFTEST_SECONDS"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(scope="module")
def device():
    if not found():
        pytest.skip("no OpenCL device")
    return open_device()


@pytest.fixture
def bare(tmp_path):
    """The environment of a user with an empty home."""
    (tmp_path / "home").mkdir(mode=0o700)
    here = {k: v for k, v in os.environ.items() if not k.startswith(("XDG_", "MPL"))}
    return here | {"HOME": str(tmp_path / "home")}


def compute(env, before="", command=(), **more):
    """A kernel of the self-test, built and launched in a process of its own."""
    code = before + COMPUTE
    done = subprocess.run(
        [*command, sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=120, check=False, **more
    )
    assert done.stdout.strip() == "computed", done.stderr
    assert not done.stderr
    return done


# Code of others


def test_pickles_of_others_are_not_read(device, bare, tmp_path):
    """PyOpenCL's cache of generated code, poisoned where all programs share it."""
    fill = [sys.executable, "-c", SHARED]
    subprocess.run(fill, env=bare, capture_output=True, timeout=120, check=True)
    poison = (
        "import os, pickle, sqlite3, sys\n"
        "class Evil:\n"
        f"    def __reduce__(self): return os.mkdir, ({str(tmp_path / 'evil')!r},)\n"
        "with sqlite3.connect(sys.argv[1]) as data:\n"
        "    assert data.execute('UPDATE dict SET key_value = ?', (pickle.dumps(Evil()),)).rowcount\n"
    )
    (shared,) = (tmp_path / "home").rglob("pytools/*.sqlite")
    subprocess.run([sys.executable, "-c", poison, shared], check=True, timeout=60)
    subprocess.run(fill, env=bare, capture_output=True, timeout=120, check=False)
    (tmp_path / "evil").rmdir()  # the poison works, where that cache is on

    for before in ("", "import pyopencl.invoker\n"):
        compute(bare, before)
        assert not (tmp_path / "evil").exists()


def test_all_caches_lie_in_one_private_folder(device, bare, tmp_path):
    """Whatever the umask; of the command, and of whatever else is imported."""
    write_demo_sequence(tmp_path, 2, (16, 24))
    done = stss(
        "run", tmp_path / "frames", "-o", tmp_path / "out", "--method", "bilinear", env=bare | {"XDG_CACHE_HOME": ""}, umask=0
    )
    assert done.returncode == 0, done.stderr
    compute(bare, umask=0)
    home = tmp_path / "home"
    assert [path.relative_to(home) for path in (*home.iterdir(), *(home / ".cache").iterdir())] == [
        Path(".cache"),
        Path(".cache/stss"),
    ]
    folders = [home / ".cache", home / ".cache" / "stss", *(home / ".cache" / "stss").iterdir()]
    assert [stat.S_IMODE(path.stat().st_mode) for path in folders] == [0o700] * len(folders)


def test_folders_above_the_cache_are_private_too(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a" / "b" / "cache"))
    umask = os.umask(0)
    try:
        caches.private("pocl")
    finally:
        os.umask(umask)
    assert [stat.S_IMODE((tmp_path / part).stat().st_mode) for part in ("a", "a/b", "a/b/cache")] == [0o700] * 3


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no users on this system")
def test_a_cache_home_of_somebody_else_is_refused(tmp_path, monkeypatch):
    (tmp_path / "theirs").mkdir(mode=0o755)
    if os.getuid() == 0:
        os.chown(tmp_path / "theirs", NOBODY, NOBODY)
    else:
        monkeypatch.setattr(os, "getuid", lambda: NOBODY)
    (tmp_path / "link").symlink_to(tmp_path / "theirs")
    for place in ("theirs", "link"):  # a link is followed: what counts is where it leads
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / place))
        with pytest.raises(DeviceError, match=r"^kernel cache .*theirs: belongs to user \d+, not to you; set XDG_CACHE_HOME"):
            caches.private("pocl")
    assert not list((tmp_path / "theirs").iterdir())


def test_a_linked_cache_home_is_resolved(tmp_path, monkeypatch):
    (tmp_path / "real").mkdir(mode=0o700)
    (tmp_path / "link").symlink_to(tmp_path / "real")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "link"))
    assert caches.private("pocl") == (tmp_path / "real" / "stss" / "pocl").resolve()


def test_a_driver_without_a_cache_gets_binaries_without_pickles(device, monkeypatch, tmp_path):
    monkeypatch.setattr(program, "has_src_build_cache", lambda handle: None)
    kept = tmp_path / "cache" / "stss" / "binaries"
    for content in (None, b"", b"not a binary"):
        if content is not None:
            next(kept.iterdir()).write_bytes(content)
        program.build(open_device(device.name), "selftest.cl")
        (binary,) = kept.iterdir()
        assert len(binary.read_bytes()) > 1000
    monkeypatch.setattr(program, "source", lambda file: pytest.fail("expected the binary"))


# Without a home


def file(path):
    path.write_text("")


def circle(path):
    path.symlink_to(path)


def long(path):
    return path.joinpath(*["long" * 50] * 4)


HOMES = {  # name: what makes it at the path given, and what may be below it
    "a file": file,
    "a pipe": os.mkfifo if hasattr(os, "mkfifo") else None,
    "a circle of links": circle,
    "below a file": lambda path: (file(path), path / "below")[1],
    "in /proc": lambda path: Path("/proc/nope"),
    "longer than PoCL takes": long,
    "relative": lambda path: Path("relative"),
}


@pytest.mark.parametrize("variable", ["XDG_CACHE_HOME", "HOME"])
@pytest.mark.parametrize("kind", HOMES)
def test_where_nothing_can_be_kept_a_private_temporary_folder_serves(tmp_path, monkeypatch, kind, variable):
    place = HOMES[kind](tmp_path / "home") or tmp_path / "home"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "no" if variable == "XDG_CACHE_HOME" else place))
    monkeypatch.setenv(variable, str(place))
    if (kind, variable) == ("relative", "XDG_CACHE_HOME"):
        monkeypatch.setenv("HOME", "")  # a relative cache home counts as unset, and so does an empty home
    folder = caches.private("pocl")
    assert caches.is_temporary()
    assert not folder.is_relative_to(tmp_path)
    assert stat.S_IMODE(folder.parents[1].stat().st_mode) == 0o700


@pytest.fixture
def fresh_temporary():
    caches._temporary.cache_clear()
    yield
    caches._temporary.cache_clear()


def test_a_full_disk_is_left_alone(monkeypatch, fresh_temporary):
    """Compilers end the process where they cannot write."""
    room, home, disk = namedtuple("usage", "free"), caches.home(), shutil.disk_usage
    monkeypatch.setattr(shutil, "disk_usage", lambda path: room(1 << 20) if path == home else disk(path))
    assert caches.is_temporary()
    caches._temporary.cache_clear()
    monkeypatch.setattr(shutil, "disk_usage", lambda path: room(1 << 20))
    with pytest.raises(DeviceError, match=r"^kernel cache: expected 32 MiB free in the cache home or in /"):
        caches.private("pocl")


def test_what_cannot_be_written_is_not_there(tmp_path, monkeypatch):
    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    caches.store(tmp_path / "file", b"x")
    assert not list(tmp_path.iterdir())


def test_no_place_at_all_is_one_line(monkeypatch, fresh_temporary):
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nope")
    monkeypatch.setattr(caches.tempfile, "mkdtemp", lambda **_: (_ for _ in ()).throw(FileNotFoundError("none")))
    with pytest.raises(DeviceError, match=r"^kernel cache: neither the cache home nor a temporary folder can be written to"):
        caches.private("pocl")


def test_without_a_home_kernels_are_built_and_run(device, bare):
    compute(bare | {"HOME": "/proc/nope"})


def test_an_unprivileged_user_without_a_home(device, bare):
    """The installation can be read and not written to; as root, with the privilege to read alone."""
    command = ()
    if os.getuid() == 0:
        keep = "-all,+dac_read_search"
        command = (
            "setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", f"--inh-caps={keep}", f"--ambient-caps={keep}",
        )  # fmt: skip
        if not shutil.which("setpriv") or subprocess.run([*command, "true"], capture_output=True, check=False).returncode:
            pytest.skip("setpriv is not there, or cannot drop root's privileges here")
    before = "import os, pathlib, stss_cl\nassert os.getuid() and not os.access(pathlib.Path(stss_cl.__file__), os.W_OK)\n"
    if os.getuid() != 0 and os.access(stss_cl.__file__, os.W_OK):
        before = ""  # the developer's own checkout
    compute(bare | {"HOME": "/nonexistent"}, before, command)


# A busy machine


def child(text):
    return (sys.executable, "-c", "import os, sys, time\n" + text)


ANSWER = f"print({PASSED!r}, flush=True)\n"


def test_a_slow_clock_is_no_hang(monkeypatch):
    """Three times the limit on the clock, a fraction of it on the processor: what a busy machine makes of a self-test."""
    monkeypatch.setenv("STSS_SELFTEST_SECONDS", "1")
    busy = "for _ in range(30):\n    end = time.process_time() + 0.01\n    while time.process_time() < end: pass\n    time.sleep(0.09)\n"
    got = run_selftest(NAME, child(busy + ANSWER))
    assert got.passed, got
    assert got.seconds > 2.7


HANGS = {  # what the child does: what is said
    "while True: pass": "hung: no answer within 1 s of processor time",
    "time.sleep(60)": "hung: no answer, and idle for 1 s",
    "os.fork()\nwhile os.getpid() % 1 == 0: pass": "hung: no answer within 1 s of processor time",
}


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="this system does not tell processor time")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("text", HANGS)
def test_a_hang_is_a_hang(monkeypatch, text):
    monkeypatch.setenv("STSS_SELFTEST_SECONDS", "1")
    assert str(run_selftest(NAME, child(text))) == HANGS[text]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_what_a_self_test_leaves_behind_ends_with_it(tmp_path):
    """It holds the output open, and would be waited for."""
    pid = tmp_path / "pid"
    left = f"if os.fork() == 0:\n    open({str(pid)!r}, 'w').write(str(os.getpid()))\n    time.sleep(100)\n"
    wait = f"while not os.path.exists({str(pid)!r}) or not open({str(pid)!r}).read(): time.sleep(0.01)\n"
    got = run_selftest(NAME, child(left + wait + ANSWER))
    assert got.passed
    assert got.seconds < 50
    gone = time.monotonic() + 20  # a signal is on its way for a moment
    while runs(pid.read_text()) and time.monotonic() < gone:
        time.sleep(0.01)
    assert not runs(pid.read_text())


def runs(pid: str) -> bool:
    """Whether a process is there, and is more than a name that nobody has asked for yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


NOT_THE_DEVICE = {  # what ended the self-test, and says nothing about the device
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
    assert known(NAME, HANDLE) is None
    assert verdict(NAME, HANDLE, command=child(ANSWER)).passed


def test_a_fault_of_the_driver_is_kept():
    verdict(NAME, HANDLE, command=child(f"os.kill(os.getpid(), {int(signal.SIGSEGV)})"))
    assert known(NAME, HANDLE).outcome == "crashed"


@pytest.mark.skipif(verdicts.fcntl is None, reason="no file locks on this system")
def test_one_process_tests_while_others_wait(tmp_path):
    """All have its verdict: none of several first starts at once is refused."""
    begun, go, waiting = tmp_path / "begun", tmp_path / "go", threading.Barrier(4, timeout=60)
    slow = child(
        f"open({str(begun)!r}, 'a').write('x')\n" + f"while not os.path.exists({str(go)!r}): time.sleep(0.01)\n" + ANSWER
    )
    got, told = [], []

    def start():
        def tell(line):
            told.append(line)
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
    assert begun.read_text() == "x"
    assert sorted(line.split()[0] for line in told) == ["first", "waiting", "waiting", "waiting"]


@pytest.mark.skipif(verdicts.fcntl is None, reason="no file locks on this system")
def test_a_dead_holder_frees_the_lock():
    lock = verdicts._path(NAME, HANDLE).with_suffix(".lock")
    hold = "import fcntl, sys\nf = open(sys.argv[1], 'a')\nfcntl.flock(f, fcntl.LOCK_EX)\nprint(flush=True)\nsys.stdin.read()\n"
    with subprocess.Popen([sys.executable, "-c", hold, lock], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        holder.stdout.readline()
        holder.kill()
    told = []
    assert verdict(NAME, HANDLE, command=child(ANSWER), tell=told.append).passed
    assert len(told) == 1


def test_processes_that_build_in_an_empty_cache_at_once_all_succeed(device, bare, tmp_path):
    code = "import sys; sys.stdin.readline()\n" + COMPUTE
    command = [sys.executable, "-c", code]
    starts = [subprocess.Popen(command, env=bare, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(4)]
    for each in starts:
        each.stdin.write("\n")
        each.stdin.flush()
    assert [each.communicate(timeout=120)[0].strip() for each in starts] == ["computed"] * 4


def test_a_build_that_another_process_disturbed_is_tried_again(device, monkeypatch):
    build, calls = cl.Program.build, []

    def disturbed(self, *args, **more):
        calls.append(1)
        if len(calls) == 1:
            raise cl.RuntimeError("clBuildProgram failed: BUILD_PROGRAM_FAILURE")
        return build(self, *args, **more)

    monkeypatch.setattr(program, "has_src_build_cache", lambda handle: True)
    monkeypatch.setattr(cl.Program, "build", disturbed)
    program.build(open_device(device.name), "selftest.cl")
    assert len(calls) == 2


# What the user sets or edits


@pytest.mark.parametrize("limit", ["inf", "nan"])
def test_a_limit_that_is_none_is_one_line(device, bare, limit):
    refused(stss("devices", env=bare | {"XDG_CACHE_HOME": "", "STSS_SELFTEST_SECONDS": limit}), "STSS_SELFTEST_SECONDS", "86400")


GOOD = {"device": NAME, "outcome": "passed", "why": "", "gflops": 5.0, "seconds": 1.0}
EDITED = {
    "no number": {**GOOD, "gflops": float("nan")},
    "infinite": {**GOOD, "seconds": float("inf")},
    "negative": {**GOOD, "gflops": -1},
    "a text for a number": {**GOOD, "gflops": "5"},
    "true for a number": {**GOOD, "gflops": True},
    "a number for a text": {**GOOD, "why": 5},
    "an outcome that is none": {**GOOD, "outcome": "perfect"},
    "an outcome that is a list": {**GOOD, "outcome": ["passed"]},
    "another device": {**GOOD, "device": "B: gpu"},
    "a key more": {**GOOD, "lasting": True},
    "a key less": {k: v for k, v in GOOD.items() if k != "seconds"},
    "a list": [GOOD],
    "not UTF-8": b'{"device": "\xff"}',
    "deep": b"[" * 60000,
    "huge": json.dumps(GOOD).encode() + b" " * (1 << 20),
    "digits": json.dumps(GOOD).replace("5.0", "9" * 5000).encode(),
    "more than a float holds": json.dumps(GOOD).replace("5.0", "9" * 400).encode(),
    "empty": b"",
}


@pytest.mark.parametrize("kind", EDITED)
def test_a_verdict_edited_by_hand_is_none(kind):
    path, what = verdicts._path(NAME, HANDLE), EDITED[kind]
    path.write_text(json.dumps(GOOD))
    assert known(NAME, HANDLE).passed
    path.write_bytes(what if isinstance(what, bytes) else json.dumps(what).encode())
    assert known(NAME, HANDLE) is None


@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_a_verdict_that_is_no_file_is_none(tmp_path, kind):
    path, other = verdicts._path(NAME, HANDLE), tmp_path / "other"
    other.write_text(json.dumps(GOOD))
    {"link": lambda: path.symlink_to(other), "pipe": lambda: os.mkfifo(path), "folder": path.mkdir}[kind]()
    assert known(NAME, HANDLE) is None
    assert verdict(NAME, HANDLE, command=child(ANSWER)).passed
    assert json.loads(other.read_text()) == GOOD


def test_a_drivers_words_do_not_steer_the_terminal():
    got = run_selftest(NAME, child("sys.stderr.write('\\x1b[2Jboo\\x07')"))
    assert str(got) == "failed: ?[2Jboo?"


@pytest.mark.parametrize("room", [".", *sorted(path.parent.name for path in Path(stss_cl.__file__).parent.glob("*/__init__.py"))])
def test_a_verdict_lapses_with_a_change_in_any_room(monkeypatch, tmp_path, room):
    copy = tmp_path / "stss_cl"
    shutil.copytree(Path(stss_cl.__file__).parent, copy)
    monkeypatch.setattr(stss_cl, "__file__", str(copy / "__init__.py"))

    def key():
        verdicts._sources.cache_clear()
        return verdicts._sources()

    before = key()
    for file in sorted((copy / room).glob("*.py")):
        with file.open("a") as text:
            text.write("# another\n")
        assert key() != before, file.name
        before = key()
    verdicts._sources.cache_clear()


def test_the_key_of_a_verdict_names_kernels_bounds_and_reference():
    names = {path.name for path in verdicts._judged()}
    kernels = {path.name for path in program.KERNELS.iterdir() if path.suffix in (".cl", ".clh")}
    assert names >= kernels | {"tuning.toml", "tolerance.py", "selftest.py", "warp.py", "caches.py", "stream.py", "conv.py"}
