# SPDX-License-Identifier: MIT
"""Folders for compiled kernels that nobody else can write to: what lies in them is loaded and executed."""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

from stss_cl.errors import DeviceError

WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH


def home() -> Path:
    """``$XDG_CACHE_HOME``, or ``~/.cache``; made if need be, a private temporary folder where that cannot be."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    try:
        # A relative path counts as unset (XDG Base Directory Specification): it would follow the working directory.
        folder = Path(named) if Path(named).is_absolute() else Path.home() / ".cache"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: no home
        return _temporary()
    return folder if os.access(folder, os.W_OK | os.X_OK) else _temporary()


def private(*parts: str) -> Path:
    """The folder ``stss/<parts>`` of ``home()``, made with mode 0700 if need be.

    Raises:
        DeviceError: it, or one above it, is not a folder, belongs to another user, or sits where others may replace it.
    """
    folder = home()
    found = folder.stat()
    if _others_rule(found):
        raise DeviceError(
            f"kernel cache {folder}: expected a folder that only you can write to; chmod o-w, or set XDG_CACHE_HOME"
        )
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


@contextmanager
def pocl_cache(version: str) -> Generator[None]:
    """PoCL keeps what it compiles in a private folder, one for each ``version`` of it, unless the user named one.

    PoCL reads ``$POCL_CACHE_DIR`` when it is first asked for its devices and never again; the environment is put back
    afterwards, for a child process may hold another PoCL.
    """
    _pin_threads()
    if "POCL_CACHE_DIR" in os.environ:
        yield
        return
    os.environ["POCL_CACHE_DIR"] = str(private("pocl", version))
    try:
        yield
    finally:
        del os.environ["POCL_CACHE_DIR"]


def _pin_threads() -> None:
    """Have PoCL keep each of its threads on a processor of its own, where this process may use all of them.

    Left alone, two of its threads were seen sharing one processor for whole seconds while another was idle: twice the time. Its
    threads look at the environment when they start, whenever that is, so the variable stays.
    """
    if hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) == os.cpu_count():
        os.environ.setdefault("POCL_AFFINITY", "1")


def _secure(folder: Path) -> bool:
    """Refuse what another user made; take from others the right to write to what is ours. True: they had it."""
    if not hasattr(os, "getuid"):
        return False  # Windows: the profile's folder has its own access list
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode):
        raise DeviceError(f"kernel cache {folder}: expected a folder, got something else, or a link")
    if found.st_uid != os.getuid():
        raise DeviceError(
            f"kernel cache {folder}: belongs to user {found.st_uid}, not to you; set XDG_CACHE_HOME to another place"
        )
    if not found.st_mode & WRITABLE_BY_OTHERS:
        return False
    folder.chmod(stat.S_IMODE(found.st_mode) & ~WRITABLE_BY_OTHERS)
    return True


def _empty(folder: Path) -> None:
    """Remove what others may have put there."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _others_rule(found: os.stat_result) -> bool:
    """Whether others may rename what lies in this folder. A group may be the user's own, so only "all" counts."""
    return hasattr(os, "getuid") and bool(found.st_mode & stat.S_IWOTH) and not found.st_mode & stat.S_ISVTX


@lru_cache(1)
def _temporary() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="stss-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
