# SPDX-License-Identifier: MIT
"""One process at a time writes to a folder."""

from __future__ import annotations

import errno
import os
import platform
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from stss_ground.errors import InputError
from stss_ground.output.write_whole import told

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

LOCK = ".stss-lock"
"""Name of the lock file, in the folder while a process writes there: it says which process, on which machine, since when."""
_NO_LOCKS = {errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK, errno.EINVAL}
"""Errors of a file system that has no locks."""
_WITHOUT_LINKS = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0)


@contextmanager
def locked(folder: Path) -> Generator[None, None, None]:
    """Lock ``folder`` against other processes that write to it.

    The system releases the lock when the process ends, however it ends. A file system without locks (some network file systems) has
    the file alone as the lock: after a kill it must be removed by hand, and the message says so.

    Args:
        folder: exists.

    Raises:
        InputError: another process has it, or the folder can't be written to.
    """
    path = folder / LOCK
    with told(folder):
        handle = _take(path)
        try:
            _sign(handle)
        except OSError:
            _release(path, handle)
            raise
    try:
        yield
    finally:
        _release(path, handle)


def _take(path: Path) -> int:
    while True:
        handle, made = _open(path)
        try:
            if not _flock(handle):
                if made:
                    return handle
                raise InputError(f"{path.parent}: {_holder(handle)}; if it ended long ago, remove {path}")
        except BlockingIOError:
            holder = _holder(handle)
            os.close(handle)
            raise InputError(f"{path.parent}: {holder}; wait for its end, or choose another folder") from None
        except BaseException:
            os.close(handle)
            raise
        if _is_at(path, handle):
            return handle
        os.close(handle)  # its holder has just removed it: other processes no longer see the file that is locked here


def _open(path: Path) -> tuple[int, bool]:
    """Open the file; returns its handle, and whether it was made."""
    try:
        return os.open(path, _WITHOUT_LINKS | os.O_CREAT | os.O_EXCL, 0o666), True
    except FileExistsError:
        with told(path):
            return os.open(path, _WITHOUT_LINKS | os.O_CREAT, 0o666), False


def _flock(handle: int) -> bool:
    """Lock the file; False where there are no locks. Raises BlockingIOError if another process has it."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return False
        raise
    return True


def _is_at(path: Path, handle: int) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.lstat())
    except FileNotFoundError:
        return False


def _sign(handle: int) -> None:
    os.ftruncate(handle, 0)
    os.write(handle, f"process {os.getpid()} on {platform.node()} since {time.strftime('%Y-%m-%d %H:%M:%S')}\n".encode())


def _holder(handle: int) -> str:
    text = os.pread(handle, 200, 0) if hasattr(os, "pread") else b""
    words = "".join(c for c in text.decode(errors="replace").strip() if c.isprintable())
    return f"{words or 'another process'} writes there"


def _release(path: Path, handle: int) -> None:
    """Remove the file, and only then unlock it: no process may lock a file that is about to be removed."""
    if fcntl is None:
        os.close(handle)  # no lock is on it, and Windows does not remove an open file
    with suppress(OSError):  # a file that stays behind stops no process that can lock it
        path.unlink()
    if fcntl is not None:
        os.close(handle)
