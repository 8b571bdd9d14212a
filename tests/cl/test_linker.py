"""Machines without a linker: PoCL still computes, with the same bits, and the linker names what it cannot do."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from stss_cl.device import caches, linker
from stss_cl.device.kernel_files import is_whole
from stss_cl.device.own_linker import HEADER, RELOCATION, SECTION, LinkError, Section, link
from stss_ground.errors import DeviceError
from tests.cl.conftest import opened_as

pytestmark = pytest.mark.skipif(not linker.possible(), reason="PoCL links by itself on this system")

COMPUTE = """
import numpy as np, sys
from stss.devices import selftest
from stss_cl.device.discovery import open_device
from stss_cl.image_space.stages import ImageStages
random = np.random.default_rng(1)
device = open_device("pocl")
for check in (selftest.arithmetic, selftest.vectors, selftest.image_stages):
    check(device, random)
inputs = {"color": random.random((19, 33, 3), np.float32), "motion": 9 * random.random((19, 33, 2), np.float32) - 4}
sys.stdout.buffer.write(b"".join(np.ascontiguousarray(array).tobytes() for array in ImageStages(device).run_stage("warp", inputs).values()))
"""


def compute(cache, path, **environment):
    """The output of a separate process without compiled kernels, after right parts of the self-test, with many constants."""
    here = {k: v for k, v in os.environ.items() if not k.startswith(("POCL_CACHE", "STSS_LINKER"))}
    env = here | {"XDG_CACHE_HOME": str(cache), "PATH": str(path), "PYTHONPATH": str(Path(__file__).parents[2])} | environment
    return subprocess.run([sys.executable, "-c", COMPUTE], env=env, capture_output=True, timeout=300, check=False)


@pytest.fixture(scope="module", autouse=True)
def pocl():
    if not opened_as("cpu").name.startswith("Portable Computing Language"):
        pytest.skip("no PoCL")


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    """What PoCL gives to its linker, kept by a linker that is ours with a copy before it."""
    folder = tmp_path_factory.mktemp("objects")
    ours = f'exec "{sys.executable}" -I -S "{linker.PROGRAM}" "$@"'
    (folder / "ld").write_text(f'#!/bin/sh\nfor a in "$@"; do case "$a" in *.o) cp "$a" "{folder}";; esac; done\n{ours}\n')
    (folder / "ld").chmod(0o700)
    process = compute(tmp_path_factory.mktemp("cache"), f"{folder}:{os.environ['PATH']}", STSS_LINKER="system")
    assert process.returncode == 0, process.stderr
    return [path.read_bytes() for path in folder.glob("*.o")]


def test_without_any_program_the_bits_are_the_same(tmp_path):
    """No ``ld``, no compiler, nothing at all in PATH, against whatever this machine has."""
    (tmp_path / "nothing").mkdir()
    alone, usual = compute(tmp_path / "a", tmp_path / "nothing"), compute(caches.home(), os.environ["PATH"])
    assert alone.returncode == 0, alone.stderr
    assert len(alone.stdout) == 19 * 33 * (3 * 4 + 1)
    assert alone.stdout == usual.stdout
    (program,) = (tmp_path / "a" / "stss" / "linker").glob("*/ld")
    assert program.stat().st_mode & 0o777 == 0o700
    kernels = {path: path.stat().st_mtime_ns for path in (tmp_path / "a").rglob("*.so")}
    again = compute(tmp_path / "a", tmp_path / "nothing")
    assert (again.returncode, again.stderr, again.stdout) == (0, b"", alone.stdout)
    assert kernels == {path: path.stat().st_mtime_ns for path in (tmp_path / "a").rglob("*.so")}, "kept for the next process"


def test_what_was_cut_short_is_seen(objects):
    for data in map(link, objects):
        assert is_whole(".so", data)
        assert not is_whole(".so", data[:-1])
        assert not is_whole(".so", bytes(len(data)))


def sections(data):
    """Where each entry of the table of sections is, and the entry."""
    _, _, _, _, _, _, table, *_, count, _ = HEADER.unpack_from(data)
    places = [table + i * SECTION.size for i in range(count)]
    return [(at, Section(*SECTION.unpack_from(data, at))) for at in places]


@pytest.mark.parametrize(("symbol", "kind", "words"), [(0, 2, "not in this object"), (1, 1, "expected relocations")])
def test_what_it_does_not_know_is_refused(objects, symbol, kind, words):
    data = bytearray(max(objects, key=len))
    link(bytes(data))
    number = next(i for i, (_, section) in enumerate(sections(data)) if section.flags & 4)  # holds code
    first = next(s.offset for _, s in sections(data) if s.kind == 4 and s.info == number)
    RELOCATION.pack_into(data, first, 0, symbol << 32 | kind, 0)
    with pytest.raises(LinkError, match=words):
        link(bytes(data))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("-o", "out.so", "missing.o"), "missing.o"),
        (("-o", "out.so", "text.o"), "expected a relocatable object of x86-64"),
    ],
)
def test_what_it_cannot_do_is_one_line(tmp_path, arguments, words):
    (tmp_path / "text.o").write_bytes(b"text" * 40)
    process = subprocess.run(
        [sys.executable, "-I", "-S", linker.PROGRAM, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert process.returncode == 1
    assert words in process.stderr
    assert len(process.stderr.splitlines()) == 1
    assert not (tmp_path / "out.so").exists()


@pytest.mark.parametrize("missing", ["ld", "libgcc.a", "libc.so"])
def test_it_is_needed_where_something_is_missing(tmp_path, monkeypatch, missing):
    monkeypatch.delenv("STSS_LINKER", raising=False)
    for name in ("bin/ld", "gcc/libgcc.a", "lib/libc.so"):
        path = tmp_path / name
        path.parent.mkdir()
        path.touch(0o700)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.setattr(linker, "COMPILERS", (str(tmp_path / "gcc"),))
    monkeypatch.setattr(linker, "LIBRARIES", (str(tmp_path / "lib"),))
    assert not linker.is_needed()
    next(tmp_path.glob(f"*/{missing}")).unlink()
    assert linker.is_needed()
    monkeypatch.setenv("STSS_LINKER", "system")
    assert not linker.is_needed()


def test_it_is_needed_without_a_path(tmp_path, monkeypatch):
    """As in a cron job whose environment is empty: PoCL then looks for ld nowhere."""
    monkeypatch.delenv("STSS_LINKER", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("PATH")
    linker.provide()
    assert shutil.which("ld", path=os.environ["PATH"]).startswith(str(tmp_path))


def test_other_choices_are_refused(monkeypatch):
    monkeypatch.setenv("STSS_LINKER", "gold")
    with pytest.raises(DeviceError, match="STSS_LINKER: expected one of own, system, got 'gold'"):
        linker.provide()
