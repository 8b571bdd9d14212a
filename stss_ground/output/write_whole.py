# SPDX-License-Identifier: MIT
"""Write a file or a folder so that it is either as before or complete."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import stat
import tempfile
import unicodedata
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from stss_ground.errors import InputError

UNFINISHED = re.compile(r"\.stss-[0-9a-f]{12}\.part")
"""The name of a file while it is written; a process that is killed leaves one behind."""
_NO_SYNC = {errno.EINVAL, errno.ENOSYS, errno.ENOTSUP}
"""Errors of a file system that cannot wait for a disk."""


def write_whole(path: Path, data: bytes) -> None:
    """Write ``data`` beside ``path``, wait until it is on the disk, and rename it into place.

    A link at ``path`` is replaced, and the file it leads to stays as it is. A file that was there keeps its mode; the umask sets a new
    one's.

    Raises:
        InputError: it can't be written; ``path`` is as it was, and nothing is left beside it.
    """
    with tell_errors(path):
        _write_beside(path, data)


def write_named(path: Path, data: bytes | str) -> None:
    """Write a file that the user named: as `write_whole`, but a link stays, and a device or a pipe is written to.

    Args:
        path: the file.
        data: bytes; text is written as UTF-8, and half of a surrogate pair, which is no character, as an escape.

    Raises:
        InputError: it can't be written.
    """
    data = encode(data) if isinstance(data, str) else data
    with tell_errors(path):
        if path.exists() and not path.is_file() and not path.is_dir():
            with path.open("wb") as file:
                file.write(data)
        else:
            _write_beside(path.resolve() if path.is_symlink() else path, data)


@contextmanager
def whole_folder(place: Path) -> Generator[Path, None, None]:
    """A folder beside ``place`` for the block to fill, then renamed to it; nothing may lie there by then. After an error there is none.

    Raises:
        InputError: it can't be made, or not be renamed.
    """
    with tell_errors(place):
        temporary = Path(tempfile.mkdtemp(prefix=".stss-", dir=place.absolute().parent))
    try:
        yield temporary
        with tell_errors(place):
            temporary.chmod(0o755)
            temporary.rename(place)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def remove_unfinished(folder: Path) -> None:
    """Remove the unfinished files of processes that were killed.

    Raises:
        InputError: the folder can't be written to.
    """
    with tell_errors(folder):
        for path in folder.iterdir():
            if UNFINISHED.fullmatch(path.name):
                path.unlink(missing_ok=True)


def encode(text: str) -> bytes:
    """Text as UTF-8, even text of a stranger's program: half of a surrogate pair becomes its escape."""
    return text.encode(errors="backslashreplace")


def make_folder(path: Path) -> None:
    """Make a folder and those above it, unless it is there.

    Raises:
        InputError: it can't be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: the folder cannot be made: {error.strerror}") from error


@contextmanager
def tell_errors(path: Path) -> Generator[None, None, None]:
    """Turn a system error about ``path`` into an InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error


def same_place(one: Path, other: Path) -> bool:
    """Whether two paths lead to one place."""
    return not {*keys_of(one)}.isdisjoint(keys_of(other))


def keys_of(path: Path) -> list[object]:
    """Values for a path; two paths of one file or folder share at least one."""
    real = Path(os.path.normcase(os.path.realpath(path)))
    if number := _number(path):
        return [real, number]
    # Not there yet: a file system that ignores case, or the form of accents, would make one file of two such names.
    name = unicodedata.normalize("NFC", unicodedata.normalize("NFC", real.name).casefold())
    return [real, (_number(real.parent) or real.parent, name)]


def _number(path: Path) -> tuple[int, int] | None:
    """The system's identity of a file or folder; None where it does not exist or has no number."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return None
    return (status.st_dev, status.st_ino) if status.st_ino else None


def _write_beside(path: Path, data: bytes) -> None:
    temporary = path.with_name(f".stss-{secrets.token_hex(6)}.part")
    try:
        with temporary.open("xb") as file:
            if path.is_file() and not path.is_symlink() and hasattr(os, "fchmod"):
                mode = stat.S_IMODE(path.stat().st_mode)  # a file that only its owner may read stays private
                if mode != stat.S_IMODE(
                    os.fstat(file.fileno()).st_mode
                ):  # a share of Windows has one mode, and refuses to set it
                    os.fchmod(file.fileno(), mode)
            file.write(data)
            file.flush()
            sync(file.fileno())
        temporary.replace(path)
    finally:
        with suppress(OSError):
            temporary.unlink()


def sync(handle: int) -> None:
    """Wait until the data is on the disk: some file systems report only then that they are full."""
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _NO_SYNC:
            raise


def sync_folder(path: Path) -> None:
    """Wait until the names in a folder are on the disk, if the system supports that: only then may another copy of a file be removed."""
    if os.name == "posix" and path.is_dir():
        handle = os.open(path, os.O_RDONLY)
        try:
            sync(handle)
        finally:
            os.close(handle)
