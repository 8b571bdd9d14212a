# SPDX-License-Identifier: MIT
"""One process at a time writes to a folder."""

from __future__ import annotations

import errno
import os
import platform
import re
import stat
import time
import warnings
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from stss_ground.errors import InputError
from stss_ground.output.write_whole import tell_errors
from stss_ground.terminal import printable

LOCK = ".stss-lock"
"""Name of the lock file, in the folder while a process writes there: it says which process, on which machine, since when."""
_NO_LOCKS = {errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK, errno.EINVAL}
"""Errors of a file system that has no locks."""
_SIGNED = re.compile(rb"(process )?\d+\s|\Z")
"""The beginning of the file: a signature of ours, or of ``SoftFileLock``; or it is empty, since a process was killed before it signed."""
_MOST_BYTES = 1024


@contextmanager
def hold_lock(folder: Path) -> Generator[None, None, None]:
    """Lock ``folder`` against other processes that write to it.

    The system releases the lock when the process ends, however it ends. On a file system without locks (some network file systems) only
    the file is the lock: after a kill on another machine it must be removed by hand, and the message says so.

    Args:
        folder: exists.

    Raises:
        InputError: another process has it, the folder can't be written to, or a file of somebody else has the lock's name.
    """
    path = folder / LOCK
    with tell_errors(folder):
        lock = _take(path)
    try:
        yield
    finally:
        # Removed before it is released: no process may lock a file that is about to be removed. Windows does not remove an open file.
        with suppress(OSError):
            path.unlink()
        with suppress(OSError):
            lock.release()
        if os.name == "nt":
            with suppress(OSError):
                path.unlink()


def _take(path: Path) -> BaseFileLock:
    _require_lock(path)
    is_new, lock, signature = not os.path.lexists(path), FileLock(path), _read(path)
    try:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # missing locks do not concern the user, until a file is left behind
                lock.acquire(blocking=False)
        except (OSError, NotImplementedError) as error:
            if isinstance(error, Timeout) or (isinstance(error, OSError) and error.errno not in _NO_LOCKS):
                raise
            if is_new:
                path.unlink(missing_ok=True)  # else it would count as the lock of another process
            lock = SoftFileLock(path)
            lock.acquire(blocking=False)
    except Timeout:
        soft = type(lock) is SoftFileLock
        remedy = f"if it ended long ago, remove {path}" if soft else "wait for its end, or choose another folder"
        if signature and not _read(path):  # before version 4 of filelock, trying a lock empties its file
            with (
                suppress(OSError),
                path.open("r+", encoding="utf-8") as file,
            ):  # never a new file: the other process may have ended
                file.write(signature)
        raise InputError(f"{path.parent}: {printable(signature.strip()) or 'another process'} writes there; {remedy}") from None
    if type(lock) is not SoftFileLock:  # which signs itself
        signature = f"process {os.getpid()} on {platform.node()} since {time.strftime('%Y-%m-%d %H:%M:%S')}\n"
        path.write_text(signature, encoding="utf-8")
    return lock


def _require_lock(path: Path) -> None:
    """Raise InputError for a file that is no lock of ours: taking it would empty a link's target or a file of the user's."""
    if not os.path.lexists(path):
        return
    status = path.lstat()
    if (
        not stat.S_ISREG(status.st_mode)
        or status.st_nlink != 1
        or status.st_size > _MOST_BYTES
        or not _SIGNED.match(path.read_bytes())
    ):
        raise InputError(f"{path}: expected the lock of a run, found something else; remove it, or choose another folder")


def _read(path: Path) -> str:
    try:
        return path.read_bytes()[:_MOST_BYTES].decode(errors="replace")
    except OSError:
        return ""
