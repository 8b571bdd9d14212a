# SPDX-License-Identifier: MIT
"""Folders for compiled kernels, which no other user can write to, since their content is loaded and executed."""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import tempfile
from collections.abc import Generator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path

from stss_ground.errors import DeviceError
from stss_ground.machine import available_threads

LEAST_FREE = 32 << 20
"""Bytes that must be free in the cache: all of our kernels take about 10 MiB, and compilers crash on a full disk."""
LARGEST = 1 << 20
"""Bytes of the largest file in the cache, twice over; a compiler that cannot write ends the process."""
LONGEST = 512
"""Most characters of the cache home's path: PoCL ends the process if a path in its cache has more than 1023."""

WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH


def home() -> Path:
    """The cache home: ``$XDG_CACHE_HOME`` or ``~/.cache``, with links resolved, made if need be; else a private temporary folder.

    Raises:
        DeviceError: there is no place for a temporary folder either.
    """
    home = os.environ.get("XDG_CACHE_HOME", "")
    try:
        # A relative path counts as unset (XDG Base Directory Specification): it would follow the working directory.
        folder = Path(home) if Path(home).is_absolute() else _user_home() / ".cache"
        _make(folder)
        folder = folder.resolve(strict=True)
        return folder if _serves(folder) else temporary_folder()
    except (OSError, RuntimeError):  # RuntimeError: no home, or links in a circle
        return temporary_folder()


def is_temporary() -> bool:
    """Whether compiled kernels are lost when the process ends, since no cache home can be written to."""
    where = home()
    return bool(temporary_folder.cache_info().currsize) and where == temporary_folder()


def private(*parts: str) -> Path:
    """The folder ``stss/<parts>`` of ``home()``, made with mode 0700 if need be.

    Raises:
        DeviceError: it, or a folder above it, is not a folder, belongs to another user, or lies where others may replace it.
    """
    folder = home()
    _refuse_others(folder)
    for part in ("stss", *parts):
        folder /= part
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
            if _secure(folder) and part != "stss":
                _empty(folder)
        except OSError as error:
            raise DeviceError(
                f"kernel cache {folder}: cannot be used: {error.strerror}; set XDG_CACHE_HOME to another place"
            ) from None
    return folder


def store(path: Path, data: bytes, *, executable: bool = False) -> None:
    """Write a file of a private folder, whole or not at all; if that fails (a full disk, ...) there is no file."""
    with suppress(OSError):
        handle, beside = tempfile.mkstemp(dir=path.parent, prefix=".")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
            if executable:
                Path(beside).chmod(stat.S_IRWXU)
            Path(beside).replace(path)
        except OSError:
            Path(beside).unlink()


def read(path: Path, most: int) -> bytes | None:
    """Read a file of ``store``; None if it is not there, has more than ``most`` bytes, or is a link, a pipe or a folder."""
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        with os.fdopen(os.open(path, flags), "rb") as file:
            status = os.fstat(file.fileno())
            return file.read(most) if stat.S_ISREG(status.st_mode) and status.st_size <= most else None
    except OSError:
        return None


@contextmanager
def pocl_cache(version: str) -> Generator[Path]:
    """Let PoCL store compiled kernels in a private folder, one for each ``version`` of PoCL, unless the user named a folder; yields it.

    PoCL reads ``$POCL_CACHE_DIR`` when it is first asked for its devices and never again; the environment is restored
    afterwards, since a child process may load another PoCL.
    """
    _choose_threads()
    if "POCL_CACHE_DIR" in os.environ:
        yield Path(os.environ["POCL_CACHE_DIR"])
        return
    folder = private("pocl", version)
    os.environ["POCL_CACHE_DIR"] = str(folder)
    try:
        yield folder
    finally:
        del os.environ["POCL_CACHE_DIR"]


def _choose_threads() -> None:
    """Let PoCL pin each of its threads to a processor if this process may use all processors; else have no more threads than it may use.

    Unpinned, two threads shared one processor for whole seconds while another was idle, which doubles the time. Threads beyond a
    container's share of time use it up at once, and all wait for the next. They read the environment when they start, at an unknown
    moment, so the variables stay.
    """
    if not hasattr(os, "sched_getaffinity"):
        return
    if (usable := available_threads()) == os.cpu_count():
        os.environ.setdefault("POCL_AFFINITY", "1")
    else:
        os.environ.setdefault("POCL_MAX_PTHREAD_COUNT", str(usable))


def _secure(folder: Path) -> bool:
    """Refuse a folder of another user, and remove the right of others to write to ours. Returns whether they had it."""
    if not hasattr(os, "getuid"):
        return False  # Windows: the profile's folder has its own access list
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode):
        raise DeviceError(f"kernel cache {folder}: expected a folder, got something else, or a link")
    if status.st_uid != os.getuid():
        raise DeviceError(
            f"kernel cache {folder}: belongs to user {status.st_uid}, not to you; set XDG_CACHE_HOME to another place"
        )
    if not status.st_mode & WRITABLE_BY_OTHERS:
        return False
    folder.chmod(stat.S_IMODE(status.st_mode) & ~WRITABLE_BY_OTHERS)
    return True


def _empty(folder: Path) -> None:
    """Remove files that others may have put there."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _make(folder: Path) -> None:
    """``mkdir -p`` with mode 0700 for each new folder under any umask; ``mkdir(parents=True)`` would open the upper ones to others."""
    for each in (*reversed(folder.parents), folder):
        if not each.exists():
            each.mkdir(mode=0o700, exist_ok=True)


def _user_home() -> Path:
    if os.environ.get("HOME") == "":
        raise RuntimeError("an empty HOME stands for the root folder")
    folder = Path.home()
    if not folder.is_absolute():
        raise RuntimeError("a relative HOME follows the working directory")
    return folder


def _serves(folder: Path) -> bool:
    """Whether the folder can be written to, its files can be executed, and it has room."""
    return (
        len(str(folder)) <= LONGEST
        and os.access(folder, os.R_OK | os.W_OK | os.X_OK)
        and _executes(folder)
        and shutil.disk_usage(folder).free >= LEAST_FREE
        and _takes(folder)
    )


@lru_cache
def _takes(folder: Path) -> bool:
    """Whether a file as large as any kernel can be written: quotas and the rules of shares show in nothing else."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(LARGEST))
    except OSError:
        return False
    return True


def _executes(folder: Path) -> bool:
    """Whether compiled kernels can be loaded from there: a file system may be mounted without execution."""
    return not (hasattr(os, "statvfs") and os.statvfs(folder).f_flag & getattr(os, "ST_NOEXEC", 0))


def _refuse_others(folder: Path) -> None:
    """Refuse a home that another user owns or that all may write to, or that lies in such a folder: they could replace it.

    A group may be the user's own, so only the right of all counts; root can replace anything anyway.
    """
    if not hasattr(os, "getuid"):
        return
    for each in (folder, *folder.parents):
        status = each.stat()
        if status.st_uid not in (os.getuid(), 0):
            raise DeviceError(
                f"kernel cache {each}: belongs to user {status.st_uid}, not to you; set XDG_CACHE_HOME to another place"
            )
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            raise DeviceError(
                f"kernel cache {each}: expected a folder that only you can write to; chmod o-w, or set XDG_CACHE_HOME"
            )


@lru_cache(1)
def temporary_folder() -> Path:
    """A folder for this process alone, if the cache home cannot be used; DeviceError if this cannot be made either."""
    try:
        folder = Path(tempfile.mkdtemp(prefix="stss-"))
    except OSError:
        raise DeviceError(
            "kernel cache: neither the cache home nor a temporary folder can be written to; set XDG_CACHE_HOME or TMPDIR"
        ) from None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    if not _serves(folder):
        raise DeviceError(
            f"kernel cache: expected {LEAST_FREE >> 20} MiB free, also by quota, and a file system with execution, in the cache home or in "
            f"{folder.parent}; set XDG_CACHE_HOME or TMPDIR"
        )
    return folder
