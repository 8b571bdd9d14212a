"""Folders for compiled kernels: private ones, at any possible place, without code of other users."""

import os
import resource
import shutil
import stat
import subprocess
import sys
from collections import namedtuple
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from stss.demo import write_demo_sequence
from stss_cl.device import caches, kernel_files, program
from stss_cl.device.caches import read
from stss_cl.device.discovery import open_device
from stss_ground.errors import DeviceError
from tests.hostile.cases import stss
from tests.tiers import thorough

NOBODY = 65534
COMPUTE = """
import os
import numpy as np
from stss.devices import selftest
from stss_cl.device.discovery import open_device
selftest.groups(open_device(), np.random.default_rng(0))
print("computed", os.environ.get("POCL_CACHE_DIR"))
"""


@pytest.fixture(autouse=True)
def cache_home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    caches.temporary_folder.cache_clear()
    yield tmp_path / "cache"
    caches.temporary_folder.cache_clear()


def build_anew(device):
    """Build a program for the same device, for which nothing is built yet."""
    opened = open_device(device.name)
    assert program.program_for(opened, "selftest.cl").handle


@pytest.fixture
def bare(tmp_path):
    """The environment of a user with an empty home."""
    (tmp_path / "home").mkdir(mode=0o700)
    here = {k: v for k, v in os.environ.items() if not k.startswith(("XDG_", "MPL", "POCL_CACHE"))}
    return here | {"HOME": str(tmp_path / "home")}


def compute(env, command=(), **more):
    """A kernel of the self-test, built and launched in a process of its own; returns its ``$POCL_CACHE_DIR``."""
    process = subprocess.run(
        [*command, sys.executable, "-c", COMPUTE], env=env, capture_output=True, text=True, timeout=120, check=False, **more
    )
    assert process.stdout.startswith("computed"), process.stderr
    assert not process.stderr
    return process.stdout.split()[1]


DAMAGE = {
    "empty": lambda data: b"",
    "cut": lambda data: data[: len(data) // 2],
    "zeros": lambda data: bytes(len(data)),
    "a bit": lambda data: data[:1000] + bytes([data[1000] ^ 8]) + data[1001:],
    "one byte more": lambda data: data + b"\0",
}


def kernels(home):
    return sorted(path for path in home.rglob("*") if path.suffix in (".bc", ".so"))


@pytest.mark.parametrize("damages", [["a bit"], thorough(["cut", "empty", "zeros", "one byte more"])], ids=str)
def test_a_damaged_kernel_is_built_anew(processor, bare, tmp_path, damages):
    """All at once here; PoCL ends the process for most of them, each time until somebody removes it. The folder is named."""
    home = tmp_path / "home"
    compute(bare)
    if not kernels(home):
        pytest.skip("no files of PoCL")
    before = {path: path.read_bytes() for path in kernels(home)}
    assert not subprocess.run([sys.executable, "-c", COMPUTE], env=bare, capture_output=True, check=True).stderr
    for how in damages:
        for path, data in before.items():
            path.write_bytes(DAMAGE[how](data))
        process = subprocess.run([sys.executable, "-c", COMPUTE], env=bare, capture_output=True, text=True, check=False)
        assert process.stdout.startswith("computed"), (how, process.stderr)
        (line,) = process.stderr.splitlines()
        assert "files are damaged and are built again" in line, how
        assert str(home / ".cache" / "stss" / "pocl") in line
        before = {path: path.read_bytes() for path in kernels(home)}
        assert compute(bare) == "None"


@pytest.mark.parametrize("how", ["empty", "cut", "zeros"])
def test_a_kernel_of_a_killed_process_is_whole_or_built_anew(processor, cache_home, tmp_path, how):
    """It is in no list, and without a digest its own tables say how long it is."""
    build_anew(processor)
    for path in kernels(cache_home):
        data = path.read_bytes()
        assert kernel_files.is_whole(path.suffix, data)
        assert not kernel_files.is_whole(path.suffix, DAMAGE[how](data))
    folder = tmp_path / "pocl"
    folder.mkdir()
    shared = bytearray(shared_object())
    for name, data in (("a/a/k/1/whole.so", shared), ("a/b/k/1/damaged.so", DAMAGE[how](bytes(shared)))):
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_bytes(data)
    kernel_files.mend(folder)
    assert [path.name for path in kernels(folder)] == ["whole.so"]


def test_what_another_process_may_be_writing_is_left_alone(tmp_path):
    """PoCL ends a process whose kernel goes while it links. What was left long ago is removed; so is all once nobody else is there."""
    folder = tmp_path / "pocl"
    for name in ("new.so", "old.so"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"")
    os.utime(folder / "old.so", (0, 0))
    code = f"from stss_cl.device.kernel_files import Path, mend; mend(Path({str(folder)!r})); print(1, flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as other:
        assert other.stdout.read(1) == b"1"
        (folder / "new.so").write_bytes(b"")
        (folder / "old.so").write_bytes(b"")
        os.utime(folder / "old.so", (0, 0))
        kernel_files.mend.__wrapped__(folder)
        assert [path.name for path in kernels(folder)] == ["new.so"]
        other.kill()
    kernel_files.mend.__wrapped__(folder)
    assert not kernels(folder)


@pytest.mark.skipif(not kernel_files.BOOT.exists(), reason="Linux alone says when it was started")
def test_what_nobody_wrote_to_since_it_was_looked_at_is_not_read_again(tmp_path, monkeypatch, capsys):
    """A file is read once after each start of the system, and whenever it was written to, whatever its times claim."""
    folder, boot, looked_at = tmp_path / "pocl", tmp_path / "boot", []
    monkeypatch.setattr(kernel_files, "BOOT", boot)
    monkeypatch.setattr(kernel_files.atexit, "register", lambda remember: remember())
    monkeypatch.setattr(kernel_files, "read", lambda path, most: looked_at.append(path.name) or read(path, most))
    boot.write_text("first")
    for name in ("a.so", "b.so"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(shared_object())

    def read_by(next_process):
        next_process()
        looked_at.clear()
        kernel_files.mend.__wrapped__(folder)
        return sorted({*looked_at} & {"a.so", "b.so"})

    def damage_quietly():
        path = folder / "b.so"
        before, data = path.stat(), bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))

    assert read_by(lambda: None) == ["a.so", "b.so"]
    assert read_by(lambda: None) == []
    assert read_by(lambda: boot.write_text("second")) == ["a.so", "b.so"]
    assert read_by(lambda: None) == []
    assert capsys.readouterr().err == ""
    assert read_by(damage_quietly) == ["b.so"]
    assert "1 of 2 files are damaged" in capsys.readouterr().err
    assert [path.name for path in kernels(folder)] == ["a.so"]
    assert read_by(boot.unlink) == ["a.so"]
    assert read_by(lambda: None) == ["a.so"]


def shared_object():
    """One of this system."""
    return next(path for path in Path(np.__file__).parent.rglob("*.so")).read_bytes()


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_all_caches_lie_in_one_private_folder(processor, bare, tmp_path):
    """Whatever the umask; of the command, and of whatever else is imported: PyOpenCL's pickles are not there."""
    write_demo_sequence(tmp_path, 2, (16, 24))
    environment = bare | {"XDG_CACHE_HOME": ""}
    process = stss(
        "run", tmp_path / "frames", "-o", tmp_path / "out", "--weights", "bilinear", "--backend", "ref", env=environment, umask=0
    )
    assert process.returncode == 0, process.stderr
    assert compute(bare, umask=0) == "None"
    home = tmp_path / "home"
    drivers = {Path(".cache/mesa_shader_cache")} if processor.name.startswith("rusticl:") else set()  # Mesa's own
    assert {path.relative_to(home) for path in (*home.iterdir(), *(home / ".cache").iterdir())} - drivers == {
        Path(".cache"),
        Path(".cache/stss"),
    }
    folders = [home / ".cache", home / ".cache" / "stss", *(home / ".cache" / "stss").iterdir()]
    assert {mode(path) for path in folders} == {0o700}


def test_a_cache_without_execution_is_not_used(tmp_path, monkeypatch):
    """Kernels could not be loaded from there, and the device would get the blame for good."""
    status, noexec = os.statvfs(tmp_path), tmp_path / "cache"
    flags = namedtuple("Flags", "f_flag f_frsize f_blocks f_bfree f_bavail")

    def statvfs(path):
        extra = os.ST_NOEXEC if Path(path) == noexec else 0
        return flags(extra, status.f_frsize, status.f_blocks, status.f_bfree, status.f_bavail)

    monkeypatch.setattr(os, "statvfs", statvfs)
    assert caches.is_temporary()
    assert caches.private("verdicts").parent.parent == caches.home() != noexec


def test_a_driver_without_a_cache_gets_binaries_without_pickles(processor, monkeypatch, cache_home):
    monkeypatch.setattr(program, "has_src_build_cache", lambda handle: None)
    folder = cache_home / "stss" / "binaries"
    for content in (None, b"", b"not a binary"):
        if content is not None:
            next(folder.iterdir()).write_bytes(content)
        build_anew(processor)
        (binary,) = folder.iterdir()
        assert len(binary.read_bytes()) > 1000
    monkeypatch.setattr(program, "source", lambda file: pytest.fail("expected the binary"))


@pytest.mark.parametrize("kind", ["a file", "longer than PoCL takes", "relative"])
def test_where_nothing_can_be_kept_a_private_temporary_folder_serves(tmp_path, monkeypatch, kind):
    place = {
        "a file": tmp_path / "file",
        "longer than PoCL takes": tmp_path.joinpath(*["long" * 50] * 4),
        "relative": Path("relative"),
    }
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(place[kind]))
    monkeypatch.setenv("HOME", "" if kind == "relative" else str(tmp_path / "file"))  # a relative cache home counts as unset
    folder = caches.private("pocl")
    assert caches.is_temporary()
    assert not folder.is_relative_to(tmp_path)
    assert mode(folder.parents[1]) == 0o700


def test_a_full_disk_is_left_alone(monkeypatch):
    """Compilers end the process where they cannot write."""
    room, home, disk = namedtuple("usage", "free"), caches.home(), shutil.disk_usage
    monkeypatch.setattr(shutil, "disk_usage", lambda path: room(1 << 20) if path == home else disk(path))
    assert caches.is_temporary()
    caches.temporary_folder.cache_clear()
    monkeypatch.setattr(shutil, "disk_usage", lambda path: room(1 << 20))
    with pytest.raises(DeviceError, match=r"^kernel cache: expected 32 MiB free, .* execution, in the cache home or in /"):
        caches.private("pocl")


def test_a_quota_that_is_used_up_is_a_full_disk(cache_home):
    """The disk has room, and this user may write no more; here by the limit of a file's size."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(DeviceError, match=r"^kernel cache: expected 32 MiB free, also by quota, "):
            caches.private("pocl")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("privileged", [True, False])
def test_a_user_without_a_home_computes(processor, bare, privileged):
    """Also one who may read the installation and not write to it; as root, with the privilege to read alone."""
    command = ()
    if not privileged:
        keep = "-all,+dac_read_search"
        command = (
            "setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", f"--inh-caps={keep}", f"--ambient-caps={keep}",
        )  # fmt: skip
        if not shutil.which("setpriv") or subprocess.run([*command, "true"], capture_output=True, check=False).returncode:
            pytest.skip("setpriv is not there, or cannot drop root's privileges here")
    compute(bare | {"HOME": "/nonexistent"}, command)


def test_a_cron_job_computes(processor, tmp_path):
    """Without PATH, HOME and locale; the cache alone is named, to have it empty."""
    compute({"XDG_CACHE_HOME": str(tmp_path)})


@pytest.mark.thorough
def test_processes_that_build_in_an_empty_cache_at_once_all_succeed(processor, bare):
    command = [sys.executable, "-c", "import sys; sys.stdin.readline()\n" + COMPUTE]
    starts = [subprocess.Popen(command, env=bare, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    for each in starts:
        each.stdin.write("\n")
        each.stdin.flush()
    assert [each.communicate(timeout=120)[0].split()[0] for each in starts] == ["computed"] * 3


def test_a_build_that_another_process_disturbed_is_tried_again(processor, monkeypatch):
    build, calls = cl.Program.build, []

    def disturbed(self, *args, **more):
        calls.append(1)
        if len(calls) == 1:
            raise cl.RuntimeError("clBuildProgram failed: BUILD_PROGRAM_FAILURE")
        return build(self, *args, **more)

    monkeypatch.setattr(program, "has_src_build_cache", lambda handle: True)
    monkeypatch.setattr(cl.Program, "build", disturbed)
    build_anew(processor)
    assert len(calls) == 2
