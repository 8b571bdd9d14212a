# SPDX-License-Identifier: MIT
"""Read small files whole. Pipes and devices, which may block or never end, are refused, and files above a limit."""

from __future__ import annotations

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def read_regular(path: Path, most: int) -> bytes:
    """Read a regular file whole.

    Args:
        path: the file; links are followed.
        most: the largest size allowed; bytes, a multiple of 1024.

    Returns:
        Its bytes.

    Raises:
        OSError: it cannot be read, is not a regular file, or is larger; ``strerror`` says which.
    """
    require_regular(path)
    # Without O_NONBLOCK this would block on a pipe that has taken the file's place since the check.
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(handle, "rb") as file:
        _require_regular(path, os.fstat(handle).st_mode)
        data = file.read(most + 1)
    if len(data) > most:
        limit = f"{most >> 20} MiB" if most >= 1 << 20 else f"{most >> 10} KiB"
        raise OSError(errno.EFBIG, f"expected at most {limit}, found more", str(path))
    return data


def read_json(path: Path, most: int) -> Any:
    """Read a regular file of JSON, from any source.

    Args:
        path: the file; links are followed.
        most: the largest size allowed; bytes, a multiple of 1024.

    Returns:
        Its value.

    Raises:
        OSError: as `read_regular`, or it holds no JSON; ``strerror`` says which.
    """
    try:
        return json.loads(read_regular(path, most))
    except (ValueError, RecursionError) as error:  # not text, not JSON, a number of too many digits, nested too deep
        raise OSError(errno.EINVAL, f"expected JSON: {' '.join(str(error).split())[:200]}", str(path)) from error


def require_regular(path: Path) -> int:
    """Raise OSError unless ``path`` is a regular file; returns its size in bytes."""
    status = path.stat()
    _require_regular(path, status.st_mode)
    return status.st_size


def _require_regular(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "something else")
        raise OSError(errno.EINVAL, f"expected a regular file, found {kind}", str(path))
