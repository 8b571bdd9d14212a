# SPDX-License-Identifier: MIT
"""Refuse to write to a file that is read, whatever link leads there."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from stss_ground.errors import InputError
from stss_ground.output.write_whole import told


def require_apart(writes: Iterable[Path], reads: Iterable[Path | None]) -> None:
    """Refuse to write to a file that is read.

    Two paths are one file if they lead to the same place through links, or to the same data (a hard link; another spelling, where
    the file system takes both).

    Args:
        writes: files that will be written, replaced or removed.
        reads: files that are read; None and files that do not exist are ignored.

    Raises:
        InputError: a file of ``writes`` is one of ``reads``.
    """
    taken = _taken(reads)
    for path in writes:
        _require_free(str(path), path, taken)


def require_places(writes: Mapping[str, Path | None], reads: Iterable[Path | None] = ()) -> None:
    """Check before the work, not after it, that the files which the user named can be written.

    Args:
        writes: option -> the file; None: not asked for.
        reads: as for `require_apart`.

    Raises:
        InputError: a file is a folder, lies in no folder, is one of ``reads``, or two options name one file.
    """
    taken = _taken(reads)
    for option, path in writes.items():
        if path is None:
            continue
        with told(path):
            if path.is_dir() or not path.absolute().parent.is_dir():
                raise InputError(f"{option} {path}: expected a file in a folder that exists")
            if path.exists() and not path.is_file():
                continue  # a pipe or a device holds nothing that could be lost
        _require_free(f"{option} {path}", path, taken)
        taken |= dict.fromkeys(_keys(path), f"{option} {path}")


def _taken(reads: Iterable[Path | None]) -> dict[object, str]:
    return {key: f"{path}, which is read" for path in reads if path is not None for key in _keys(path)}


def _require_free(what: str, path: Path, taken: Mapping[object, str]) -> None:
    for key in _keys(path):
        if key in taken:
            raise InputError(f"{what}: the same file as {taken[key]}; expected another place to write to")


def _keys(path: Path) -> list[object]:
    """Values of which two paths of one file share at least one."""
    try:
        real = os.path.normcase(os.path.realpath(path))
        found = path.stat()
    except OSError:
        return [os.path.normcase(os.path.realpath(path))]
    return [real, (found.st_dev, found.st_ino)] if found.st_ino else [real]
