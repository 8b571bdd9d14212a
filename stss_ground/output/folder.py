# SPDX-License-Identifier: MIT
"""A folder of numbered files with a list of the files that were written into it (docs/decisions/0025)."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import BinaryIO

from stss_ground.errors import InputError
from stss_ground.output.lock import LOCK, hold_lock
from stss_ground.output.write_whole import (
    UNFINISHED,
    make_folder,
    remove_unfinished,
    same_place,
    sync,
    sync_folder,
    tell_errors,
    write_whole,
)
from stss_ground.regular_file import read_regular
from stss_ground.terminal import echo

SUMS = "stss.sha256"
"""Name of the list in the folder: the SHA-256 of every file written into it, in the form of ``sha256sum``."""
MOST_BYTES = 64 << 20
"""Most bytes of the list; a line has about 90."""
_LINE = re.compile(r"([0-9a-f]{64})  (.+)")


def move_aside(path: Path) -> None:
    """Rename a file or folder of another program that is in the way, and say so."""
    aside = next(place for n in count(1) if not os.path.lexists(place := path.with_name(f"{path.name}.{n}.aside")))
    path.rename(aside)
    echo(f"{path}: not as {SUMS} says, so another program wrote it: moved to {aside.name}", err=True)


def digest_of(path: Path) -> str:
    """SHA-256 of a file of any size."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def sums_below(folder: Path) -> bytes:
    """The list of all files below a folder but the list itself; a link counts as its text."""
    lines: list[str] = []
    for path in sorted(folder.rglob("*")):
        if path.is_symlink() or (path.is_file() and path != folder / SUMS):
            digest = hashlib.sha256(os.fsencode(path.readlink())).hexdigest() if path.is_symlink() else digest_of(path)
            lines.append(f"{digest}  {path.relative_to(folder).as_posix()}\n")
    return "".join(lines).encode(errors="surrogateescape")


class OutputFolder:
    """A folder whose files a later process can recognise as written by stss, and as complete.

    A file's checksum is on the disk before the file is renamed into place. So a file that the list does not name, or that has another
    checksum, comes from another program, even if a process was killed. It is never replaced or removed, but moved aside.

    Attributes:
        path: the folder.
    """

    def __init__(self, path: Path, subfolders: Sequence[str], name: str):
        """Describe the folder; the disk is not read yet.

        Args:
            path: the folder.
            subfolders: the folders of its files, below it; "" is the folder itself.
            name: a pattern that the names of all its files match.
        """
        self.path, self._subfolders, self._name = path, tuple(subfolders), re.compile(name)
        self._sums: dict[str, list[str]] = {}
        """Name -> its checksums in the list, the newest last: a killed process may have left the older file."""
        self._names: set[str] = set()
        self._log: BinaryIO | None = None

    def present(self) -> list[Path]:
        """The existing files with names of this folder's files, and the list of checksums."""
        paths = [path for path in self._list_files() if self._name.fullmatch(path.name)]
        return [path for path in (*paths, self.path / SUMS) if os.path.lexists(path)]

    @contextmanager
    def open(self, *, refusal: str | None) -> Generator[None, None, None]:
        """Hold the folder's lock and make the folder if need be. No finished file is removed.

        Args:
            refusal: the message if an earlier process finished files; None: take the folder as it is.

        Raises:
            InputError: another process has the lock, the folder can't be written to, or it holds files that it may not.
        """
        make_folder(self.path)
        with hold_lock(self.path):
            with tell_errors(self.path):
                self._claim(refusal)
            write_whole(self.path / SUMS, self._lines())
            with tell_errors(self.path / SUMS):
                self._log = (self.path / SUMS).open("ab", buffering=0)
            try:
                yield
            finally:
                self._close()

    def write(self, name: str, data: bytes) -> None:
        """Write the file ``name``, its place below the folder.

        Raises:
            InputError: it can't be written; the old file is as it was.
        """
        path, digest = self.path / name, hashlib.sha256(data).hexdigest()
        assert self._log is not None
        with tell_errors(path):
            self._clear(name)
        self._sums.setdefault(name, []).append(digest)
        with tell_errors(self.path / SUMS):
            line = f"{digest}  {name}\n".encode()
            if self._log.write(line) != len(line):
                raise OSError("no room for a line")
            sync(self._log.fileno())
        make_folder(path.parent)
        write_whole(path, data)
        self._names.add(name)

    def keep(self, name: str) -> None:
        """Count an existing file as written by this process."""
        self._names.add(name)

    def sums(self) -> dict[str, str]:
        """The list: name -> SHA-256."""
        return {name: digests[-1] for name, digests in self._sums.items()}

    def holds(self, name: str) -> bool:
        """Whether the file is there, byte for byte as it was written."""
        return name in self._sums and self._digest(name) == self._sums[name][-1]

    def owns(self, path: Path) -> bool:
        """Whether ``path`` is the place of a file that may be written here, or of the folder's list or lock."""
        if path.name in (SUMS, LOCK) or UNFINISHED.fullmatch(path.name):
            return same_place(path.parent, self.path)
        return self._name.fullmatch(path.name) is not None and any(same_place(path.parent, folder) for folder in self.folders())

    def folders(self) -> list[Path]:
        """The folders that files are written to."""
        return [self.path / subfolder for subfolder in self._subfolders]

    def finish(self, *, remove_others: bool) -> None:
        """Rewrite the list in order, with each file once.

        Args:
            remove_others: remove the files that an earlier process wrote and this one did not.

        Raises:
            InputError: a file can't be removed or written.
        """
        for name in sorted(self._sums.keys() - self._names) if remove_others else ():
            with tell_errors(self.path / name):
                self._clear(name)
                (self.path / name).unlink(missing_ok=True)
        self._sums = {name: digests[-1:] for name, digests in self._sums.items() if (self.path / name).is_file()}
        self._close()  # Windows replaces no open file
        write_whole(self.path / SUMS, self._lines())
        for folder in self.folders():
            sync_folder(folder)

    def dissolve(self, elsewhere: Mapping[str, str]) -> None:
        """Remove each file of which another folder has an equal copy, then the list and the folders; other files stay.

        Args:
            elsewhere: name -> SHA-256 of the other folder's files.

        Raises:
            InputError: another process has the lock, or a file can't be removed.
        """
        with hold_lock(self.path), tell_errors(self.path):
            self._sums = self._read()
            self._tidy()
            for name in [name for name in self._sums if self._digest(name) == elsewhere.get(name)]:
                (self.path / name).unlink()
            self._sums = {name: digests for name, digests in self._sums.items() if os.path.lexists(self.path / name)}
            if self._sums:
                write_whole(self.path / SUMS, self._lines())
            else:
                (self.path / SUMS).unlink(missing_ok=True)
        with suppress(OSError):
            for folder in sorted(filter(Path.is_dir, self.folders()), reverse=True):
                folder.rmdir()

    def _close(self) -> None:
        with tell_errors(self.path / SUMS):
            if self._log is not None:
                self._log.close()

    def _clear(self, name: str) -> None:
        """Move a file at this place aside, unless it is the one that was written there."""
        path = self.path / name
        if not os.path.lexists(path) or self._digest(name) in self._sums.get(name, ()):
            return
        move_aside(path)

    def _digest(self, name: str) -> str:
        """SHA-256 of a file; "" where there is none, or a link."""
        path = self.path / name
        try:
            return digest_of(path) if path.is_file() and not path.is_symlink() else ""
        except OSError:
            return ""

    def _claim(self, refusal: str | None) -> None:
        for path in self.folders():
            if os.path.lexists(path) and not path.is_dir():
                raise InputError(f"{path}: expected a folder, found a file")
        self._sums = self._read()
        present = [path.relative_to(self.path).as_posix() for path in self.present() if path.name != SUMS]
        for name in present:
            if name not in self._sums:
                raise InputError(f"{self.path / name}: not in {SUMS}, so not from an earlier run; expected another folder")
            if (self.path / name).is_dir():
                raise InputError(f"{self.path / name}: expected a file, found a folder")
        if present and refusal is not None:
            raise InputError(f"{self.path}: {refusal}")
        self._tidy()

    def _tidy(self) -> None:
        for folder in filter(Path.is_dir, self.folders()):
            remove_unfinished(folder)

    def _read(self) -> dict[str, list[str]]:
        """Read the list. A line that was cut off, or that names a file elsewhere, is ignored."""
        path, sums = self.path / SUMS, dict[str, list[str]]()
        if path.is_dir():
            raise InputError(f"{path}: expected a file, found a folder")
        text = read_regular(path, MOST_BYTES).decode(errors="replace") if os.path.lexists(path) else ""
        for line in text.split("\n"):
            if (match := _LINE.fullmatch(line)) and self._is_own(match[2]):
                sums.setdefault(match[2], []).append(match[1])
        return sums

    def _is_own(self, name: str) -> bool:
        subfolder, _, last = name.rpartition("/")
        return subfolder in self._subfolders and self._name.fullmatch(last) is not None

    def _lines(self) -> bytes:
        return "".join(f"{digest}  {name}\n" for name in sorted(self._sums) for digest in self._sums[name]).encode()

    def _list_files(self) -> list[Path]:
        paths: list[Path] = []
        for folder in self.folders():
            if folder.is_dir():
                paths += sorted(folder.iterdir())
        return paths
