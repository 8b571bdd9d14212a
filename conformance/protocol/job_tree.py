# SPDX-License-Identifier: MIT
"""Open folders that somebody else has filled: every file must be a real one.

No link is followed, not even one that is put in place meanwhile: a folder stays open, and its files are opened relative to it. Where the
system has no such calls (Windows), a file is checked first and then opened.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Literal

Kind = Literal["file", "folder", "link", "other"]

MOST_NAMES = 200_000
"""Most names in one folder; a folder with more is refused before they are read into memory."""
RELATIVE = {os.open, os.mkdir, os.unlink, os.stat, os.rename} <= os.supports_dir_fd and os.listdir in os.supports_fd
_NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
_READ_FOLDER = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | _NO_LINK
# A pipe that takes a file's place after it was looked at does not block.
_READ_FILE = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | _NO_LINK
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NO_LINK


class JobError(ValueError):
    """A job folder breaks the protocol; the message names the file, what was expected and what was found, in one line."""

    def __init__(self, message: str):
        super().__init__(printable(message))


def printable(text: str) -> str:
    """``text`` with control characters, and characters that a terminal cannot show, escaped as in Python."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


class Folder:
    """An open folder; close it, or use it as a context.

    Attributes:
        path: for messages.
    """

    def __init__(self, path: Path, handle: int | None):
        """See `open_folder` and `Folder.folder`."""
        self.path = path
        self._handle = handle

    def __enter__(self) -> Folder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the folder."""
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None

    def in_place(self) -> bool:
        """Whether its path still leads to it: it was not removed, and nothing else put in its place."""
        try:
            there = self.path.lstat()
            return self._handle is None or os.path.samestat(there, os.fstat(self._handle))
        except OSError:
            return False

    def names(self) -> list[str]:
        """Names of everything in the folder, sorted.

        Raises:
            JobError: there are more than ``MOST_NAMES``, or it cannot be read.
        """
        found: list[str] = []
        with self._said(self.path), os.scandir(self.path if self._handle is None else self._handle) as entries:
            for entry in entries:
                found.append(entry.name)
                if len(found) > MOST_NAMES:
                    raise JobError(f"{self.path}: more than {MOST_NAMES} files")
        return sorted(found)

    def kind(self, name: str) -> Kind | None:
        """The kind of file with this name; None: there is none."""
        try:
            mode = os.stat(**self._at(name), follow_symlinks=False).st_mode
        except FileNotFoundError:
            return None
        except OSError as error:
            raise JobError(f"{self.path / name}: {error.strerror}") from error
        if stat.S_ISLNK(mode):
            return "link"
        return "file" if stat.S_ISREG(mode) else "folder" if stat.S_ISDIR(mode) else "other"

    def folder(self, name: str) -> Folder:
        """Open the folder of this name.

        Raises:
            JobError: there is none, or it is a link.
        """
        self.require(name, "folder")
        with self._said(self.path / name):
            return Folder(self.path / name, os.open(**self._at(name), flags=_READ_FOLDER) if RELATIVE else None)

    def made(self, name: str) -> Folder:
        """Open the folder of this name; make it if need be."""
        with self._said(self.path / name), suppress(FileExistsError):
            os.mkdir(**self._at(name))  # noqa: PTH102 (relative to the open folder)
        return self.folder(name)

    def file(self, name: str) -> BinaryIO:
        """Open the file of this name for reading.

        Raises:
            JobError: there is none, or it is a link, a pipe, a device or a folder.
        """
        self.require(name, "file")
        with self._said(self.path / name):
            file = os.fdopen(os.open(**self._at(name), flags=_READ_FILE), "rb")
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            file.close()
            raise JobError(f"{self.path / name}: not a file")
        return file

    def read(self, name: str, most: int) -> bytes:
        """Read a file's bytes.

        Raises:
            JobError: as ``file``, or it has more than ``most`` bytes.
        """
        with self.file(name) as file, self._said(self.path / name):
            data = file.read(most + 1)
        if len(data) > most:
            raise JobError(f"{self.path / name}: larger than {most} bytes")
        return data

    @contextmanager
    def written(self, name: str) -> Generator[BinaryIO, None, None]:
        """Write a new file, which replaces one of the same name once it is complete; an old file is never written into."""
        beside = f".{name}.tmp"
        with self._said(self.path / name):
            self.remove(beside)
            handle = os.open(**self._at(beside), flags=_NEW_FILE, mode=0o666)
            try:
                with os.fdopen(handle, "wb") as file:
                    yield file
                ends = {} if self._handle is None else {"src_dir_fd": self._handle, "dst_dir_fd": self._handle}
                os.replace(self._at(beside)["path"], self._at(name)["path"], **ends)  # noqa: PTH105
            except BaseException:
                self.remove(beside)
                raise

    def remove(self, name: str) -> None:
        """Remove the file of this name, if there is one; a link is removed, not what it leads to."""
        with self._said(self.path / name), suppress(FileNotFoundError):
            os.unlink(**self._at(name))

    def require(self, name: str, expected: Literal["file", "folder"]) -> None:
        """Raise JobError unless there is a real file, or folder, of this name."""
        found = self.kind(name)
        if found is None:
            raise JobError(f"{self.path / name}: {'missing' if expected == 'file' else 'no such folder'}")
        if found == "link":
            raise JobError(f"{self.path / name}: a link; a job is a tree of real files")
        if found != expected:
            raise JobError(f"{self.path / name}: not a {expected}")

    def _at(self, name: str) -> dict[str, Any]:
        return {"path": self.path / name} if self._handle is None else {"path": name, "dir_fd": self._handle}

    @staticmethod
    @contextmanager
    def _said(path: Path) -> Generator[None, None, None]:
        try:
            yield
        except OSError as error:
            raise JobError(f"{path}: {error.strerror or error}") from error


def open_folder(path: Path) -> Folder:
    """Open the folder that the user names; the path to it may have links.

    Raises:
        JobError: there is none.
    """
    try:
        if not path.is_dir():
            raise JobError(f"{path}: {'not a folder' if path.exists() else 'no such folder'}")
        return Folder(path, os.open(path, _READ_FOLDER & ~getattr(os, "O_NOFOLLOW", 0)) if RELATIVE else None)
    except OSError as error:
        raise JobError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:
        raise JobError(f"{path}: {error}") from error
