# SPDX-License-Identifier: MIT
"""Refuse, before the work, to write to a file that is read or that another program wrote, even through a link."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from stss_ground.errors import InputError
from stss_ground.output.folder import SUMS, OutputFolder
from stss_ground.output.lock import LOCK
from stss_ground.output.write_whole import keys_of, same_place, tell_errors


def require_places(
    files: Mapping[str, Path | None] | None = None,
    reads: Iterable[Path | None] = (),
    *,
    folders: Iterable[OutputFolder] = (),
    inputs: Iterable[Path] = (),
    new_folders: Iterable[Path] = (),
) -> None:
    """Check all that a command writes against all that it reads.

    Two paths are one file if they lead to the same place through links, or to the same data (a hard link; another spelling, where
    the file system takes both).

    Args:
        files: option -> the file that the user named; None: not given.
        reads: files that are read; None and files that do not exist are ignored.
        folders: the folders of many files that are written.
        new_folders: folders that the command makes: a named file may lie in one.
        inputs: files that are read; no folder may put its files beside them, since the next call would take those for inputs.

    Raises:
        InputError: a file that is written is one that is read, or the list or the lock of their folder; a named file is a folder, lies in
            no folder, or is one that another option names or that is written into a folder; a folder is one of ``inputs``, or cannot be
            written to.
    """
    inputs, folders = list(inputs), list(folders)
    places = [*new_folders, *(folder.path for folder in folders)]
    sources = [path for path in (*inputs, *reads) if path is not None]
    lists = [folder / name for folder in {path.parent for path in sources} for name in (SUMS, LOCK)]
    owners = {key: f"{path}, which is read" for path in sources for key in keys_of(path)}
    for folder in folders:
        with tell_errors(folder.path):
            for path in folder.present():
                _require_free(str(path), path, owners)
            _require_writable(folder.path)
            among = {path.parent for path in inputs}
            for place in folder.folders():
                if any(same_place(place, path) for path in among):
                    raise InputError(f"{place}: the folder of the frames that are read; expected another one")
    owners |= {key: f"{path}, which belongs to files that are read" for path in lists for key in keys_of(path)}
    for option, path in (files or {}).items():
        if path is None:
            continue
        with tell_errors(path):
            if path.is_dir() or (not path.absolute().parent.is_dir() and not _will_be(path.parent, places)):
                raise InputError(f"{option} {path}: expected a file in a folder that exists")
            if path.exists() and not path.is_file():
                continue  # a pipe or a device holds nothing that could be lost
        _require_free(f"{option} {path}", path, owners)
        for folder in folders:
            if folder.owns(path):
                raise InputError(
                    f"{option} {path}: the same file as one that is written into {folder.path}; expected another place"
                )
        owners |= dict.fromkeys(keys_of(path), f"{option} {path}")


def _require_writable(folder: Path) -> None:
    """Raise InputError where the system knows already that a folder cannot be made or written to."""
    place = next(each for each in (folder, *folder.absolute().parents) if os.path.lexists(each))
    if place.is_dir() and not os.access(place, os.W_OK | os.X_OK):
        reason = "" if place == folder else f": the folder cannot be made: {place}"
        raise InputError(f"{folder}{reason}: cannot be written to")


def _will_be(place: Path, folders: Iterable[Path]) -> bool:
    return any(same_place(each, folder) for folder in folders for each in (place, *place.parents))


def _require_free(what: str, path: Path, owners: Mapping[object, str]) -> None:
    for key in keys_of(path):
        if key in owners:
            raise InputError(f"{what}: the same file as {owners[key]}; expected another place to write to")
