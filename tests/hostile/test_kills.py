"""A process may be killed at any moment: no frame is lost, and the same command once more makes the same bytes.

What lies on the disk is kept before every operation that changes it, as a process leaves it that is killed there. From each of these
states the command is given again. ``run_kills.py`` kills real processes.
"""

import contextlib
import hashlib
import os
import shutil
import sys
import tempfile
from pathlib import Path

import pytest

from stss.run.gather import gather
from stss.run.job import folder_of
from tests.app.conftest import files
from tests.tiers import every

CHANGES = {"os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.truncate"}
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT


class States:
    """The states of a folder, each once: path -> bytes, None for a folder."""

    def __init__(self):
        self._folder, self._states = None, []
        sys.addaudithook(self._see)  # which stays for good

    @contextlib.contextmanager
    def of(self, folder):
        """Yield the list of the states before each operation of the code within, and after the last."""
        self._folder, self._states = folder, []
        try:
            yield self._states
            self.keep()
        finally:
            self._folder = None

    def keep(self):
        """Record the folder now."""
        if (folder := self._folder) is not None:
            self._folder = None  # recording itself is not recorded
            state = {
                path.relative_to(folder).as_posix(): None if path.is_dir() else path.read_bytes() for path in folder.rglob("*")
            }
            if not self._states or state != self._states[-1]:
                self._states.append(state)
            self._folder = folder

    def _see(self, event, arguments):
        if event in CHANGES or (event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITES):
            self.keep()


STATES = States()


def restore(state, folder):
    """Lay a state into a folder."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, data in state.items():
        path = folder / name
        (path if data is None else path.parent).mkdir(parents=True, exist_ok=True)
        if data is not None:
            path.write_bytes(data)


@pytest.fixture
def folder(monkeypatch):
    """In memory where there is such a place; what waits for a disk is a moment as well."""
    monkeypatch.setattr(os, "fsync", lambda handle: STATES.keep())
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=memory) as name:
        yield Path(name) / "x"


def frames(numbers, what="frame"):
    """Name -> bytes, of frames and of the holes of the odd ones."""
    names = [f"frame.{n:04d}.exr" for n in numbers] + [f"holes/frame.{n:04d}.png" for n in numbers if n % 2]
    return {name: f"{what} {name}".encode() for name in names}


def write(path, content):
    """As ``stss run --resume`` writes a folder."""
    folder = folder_of(path)
    with folder.open(refusal=None):
        for name, data in content.items():
            if folder.holds(name):
                folder.keep(name)
            else:
                folder.write(name, data)
        folder.finish(remove_others=False)


def as_listed(path):
    """The frames of a folder; its list has each of them with its checksum."""
    paths = files(path)
    lines = dict(reversed(line.split("  ")) for line in paths.pop("stss.sha256").decode().splitlines())
    assert lines == {name: hashlib.sha256(data).hexdigest() for name, data in paths.items()}
    return paths


def test_a_run_is_killed_at_every_moment(folder):
    want = frames(range(3))
    with STATES.of(folder) as states:
        write(folder, want)
    assert len(states) > 20
    for state in states:
        restore(state, folder)
        write(folder, want)
        assert as_listed(folder) == want


EARLIER = {  # what the folder has before -> what it has in the end, besides the parts' files; whether with --overwrite
    "frames that no part has": (frames([9]), frames([9]), False),
    "an earlier run": (frames(range(4), "old"), {}, True),
}


@pytest.mark.parametrize("earlier", every(2, EARLIER))
def test_gather_is_killed_at_every_moment(folder, earlier):
    """And again from two of the moments on, later."""
    earlier_files, stays, overwrite = EARLIER[earlier]
    want = frames(range(4))
    write(folder / "out", earlier_files)
    for part in ("0", "1"):
        write(folder / "parts" / part, frames([2 * int(part), 2 * int(part) + 1]))

    def go_on(state):
        """The same command from a state."""
        assert {*want.values()} <= {*state.values()}
        restore(state, folder)
        if any(name.startswith("parts/") for name in state):
            gather(folder / "parts", folder / "out", overwrite=overwrite)
        assert as_listed(folder / "out") == want | stays
        assert not [*(folder / "parts").rglob("*")]

    with STATES.of(folder) as states:
        gather(folder / "parts", folder / "out", overwrite=overwrite)
    assert len(states) > 60
    for state in states:
        go_on(state)
    for state in (states[len(states) // 2], states[-20]):
        restore(state, folder)
        with STATES.of(folder) as second:
            gather(folder / "parts", folder / "out", overwrite=overwrite)
        for state_again in second[::3]:
            go_on(state_again)
