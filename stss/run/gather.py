# SPDX-License-Identifier: MIT
"""Put the parts of a run, which separate processes wrote into separate folders, into one folder."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import NamedTuple

from stss.images.headers import read_header
from stss.run.frame_job import settings_of
from stss.run.job import folder_of
from stss_ground.errors import InputError
from stss_ground.output.folder import MOST_BYTES, SUMS, OutputFolder, digest_of
from stss_ground.output.lock import hold_lock
from stss_ground.output.places import require_places
from stss_ground.output.write_whole import remove_unfinished, sync_folder, tell_errors, write_whole
from stss_ground.progress import Track
from stss_ground.regular_file import read_regular

MARK = "stss-gathered.sha256"
"""Name of a list beside the parts, there while they are removed: the files of all parts, all of which the folder then has."""
_LINE = re.compile(r"([0-9a-f]{64})  ([^/]+)/(.+)")
_FRAME = re.compile(r"frame\.(-?\d+)\.\w+")


MOST_LISTED = 8
"""Most frames that are listed as missing."""
MADE_BY = ("backend", "version")
"""Entries that may differ, with the last bits of the pictures."""


class Content(NamedTuple):
    """The content of a folder after its parts were gathered.

    Attributes:
        parts: their number.
        frames: the number of frames in the folder.
        missing: the number of frames that it lacks.
        first_missing: the first `MOST_LISTED` of these.
        makers: devices and versions of stss that made the frames.
    """

    parts: int
    frames: int
    missing: int
    first_missing: tuple[int, ...]
    makers: tuple[str, ...]


def gather(
    parts: Path,
    out: Path,
    sequence: Path | None = None,
    *,
    frames: tuple[int, int] | None = None,
    overwrite: bool = False,
    track: Track = iter,
) -> Content:
    """Move the files of all parts into one folder, as one run would have left it. After an interrupt it can be repeated.

    No file of a part is removed before all files of all parts are in the folder and on the disk. From then on `MARK` lies beside the
    parts, until the last one is gone: it tells a repeated call the files of parts that are gone.

    Args:
        parts: holds a folder for each part. A part is a folder with a list, and no link; other files stay.
        out: the folder to write to; the rules for a run's folder hold.
        sequence: the folder or pattern of the frames that the parts were made from: nothing is written to it.
        frames: first and last frame that the folder should have afterwards; None: the first and the last that it has.
        overwrite: replace the files of an earlier run.
        track: may show how many parts are looked at, and then moved.

    Raises:
        InputError: there is no part, a file of one is not as its list says, two parts differ in a file or in their settings, a process
            writes to one, or ``out`` may not be written to.
    """
    with tell_errors(parts):
        before = _read_mark(parts / MARK)
        folders = _parts_in(parts)
    if not folders and not before:
        raise InputError(f"{parts}: expected a folder with a folder for each part of a run")
    if parts.resolve() in (out.resolve(), *out.resolve().parents):
        raise InputError(f"{out}: expected a folder outside of {parts}, which holds the parts")
    target = folder_of(out)
    inputs = [path for folder in folders for path in folder_of(folder).present()]
    if sequence is not None:
        source = sequence if sequence.is_dir() else sequence.parent
        with tell_errors(source):
            inputs += [path for path in source.iterdir() if path.is_file()]
    require_places(folders=[target], inputs=inputs)
    with hold_lock(parts), target.open(refusal=None):
        remove_unfinished(parts)
        sums, lists = _check_parts(folders, target, before, track)
        if not overwrite:
            _require_same(target, sums)
        makers = _require_alike(folders, None if overwrite else target)
        for folder in map(folders.__getitem__, track(range(len(folders)))):
            _copy(folder, target, sums)
        for name in sums:
            target.keep(name)
        target.finish(remove_others=overwrite)
        write_whole(parts / MARK, "".join(f"{digest}  {place}\n" for place, digest in (before | lists).items()).encode())
        sync_folder(parts)
        for name in sorted({place.partition("/")[0] for place in before | lists}):
            if _is_folder(parts / name):
                folder_of(parts / name).dissolve(target.sums())
    with tell_errors(parts / MARK):
        (parts / MARK).unlink(missing_ok=True)
    with suppress(OSError):
        parts.rmdir()
    there = {int(match[1]) for name in target.sums() if (match := _FRAME.fullmatch(name))}
    first, last = frames or (min(there, default=0), max(there, default=-1))
    inside = sorted(number for number in there if first <= number <= last)
    gaps = (range(a + 1, b) for a, b in pairwise([first - 1, *inside, last + 1]))  # lazily: numbers may lie far apart
    return Content(
        len(folders), len(there), last - first + 1 - len(inside), tuple(islice(chain.from_iterable(gaps), MOST_LISTED)), makers
    )


def _parts_in(parts: Path) -> list[Path]:
    """The folders of the parts.

    Raises:
        InputError: a link leads to something like a part: the folder behind it may be a finished run, and would be removed.
    """
    folders: list[Path] = []
    for path in sorted(parts.iterdir()) if parts.is_dir() else ():
        part = folder_of(path)
        if path.is_dir() and part.present():  # frames without a list too: they are reported, and not left out in silence
            for place in part.folders():
                if place.is_symlink():
                    raise InputError(f"{place}: expected the folder of a part, found a link")
            folders.append(path)
    return folders


def _read_mark(path: Path) -> dict[str, str]:
    """Part and name -> SHA-256, as the mark of a call that was interrupted has them; a line that is damaged is left out."""
    text = read_regular(path, MOST_BYTES).decode(errors="replace") if path.is_file() and not path.is_symlink() else ""
    matches = [match for line in text.split("\n") if (match := _LINE.fullmatch(line)) and match[2] not in (".", "..")]
    return {f"{match[2]}/{match[3]}": match[1] for match in matches}


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _check_parts(
    folders: Sequence[Path], target: OutputFolder, before: Mapping[str, str], track: Track
) -> tuple[dict[str, str], dict[str, str]]:
    """Look at every file of all parts.

    Returns:
        sums: name -> SHA-256: the lists of all parts and ``before`` as one.
        lists: the lists as they come into the mark.
    """
    sums, lists = dict[str, str](), dict[str, str]()
    for folder in map(folders.__getitem__, track(range(len(folders)))):
        with _open_part(folder) as part:
            for name, digest in part.sums().items():
                if sums.setdefault(name, digest) != digest:
                    raise InputError(f"{folder / name}: another part has another file of this name")
                if not part.holds(name) and not (target.sums().get(name) == digest and target.holds(name)):
                    raise InputError(f"{folder / name}: not as its list says; make this part again with --resume")
                lists[f"{folder.name}/{name}"] = digest
        # A part without a frame is one too.
        lists[f"{folder.name}/{SUMS}"] = digest_of(folder / SUMS)
    for place, digest in before.items():
        name = place.partition("/")[2]
        if name != SUMS and name not in sums:
            if target.sums().get(name) != digest or not target.holds(name):
                raise InputError(f"{target.path / name}: not as {MARK} says of {place}: first repeat the gather that was stopped")
            sums[name] = digest
    return sums, lists


def _require_same(target: OutputFolder, sums: Mapping[str, str]) -> None:
    """Raise InputError for a file in the folder that would be replaced, or that is not as the folder's list says."""
    for name, digest in target.sums().items():
        path = target.path / name
        if os.path.lexists(path):
            if sums.get(name, digest) != digest:
                raise InputError(f"{path}: a part has another frame of this name; --overwrite replaces what an earlier run wrote")
            if name not in sums and not target.holds(name):
                raise InputError(f"{path}: neither as {SUMS} says nor in a part; expected another folder")


def _require_alike(folders: Sequence[Path], target: OutputFolder | None) -> tuple[str, ...]:
    """The makers of the frames; InputError where they are of runs with different settings: the film would change its look within a shot."""
    first: tuple[Path, dict[str, str]] | None = None
    makers: dict[str, None] = {}
    for path in _frames_of(folders, target):
        try:
            attributes = read_header(path).attributes
        except InputError:  # as its list says, whatever it is
            attributes = {}
        settings = settings_of(attributes, path.suffix[1:])
        first = first or (path, settings)
        for name, value in settings.items():
            if value != first[1][name]:
                raise InputError(
                    f"{path}: {name} {value}, but {first[0]} has {first[1][name]}; expected frames of one run: make a part again"
                )
        makers[", ".join(f"{name} {attributes.get(f'stss:{name}', 'none')}" for name in MADE_BY)] = None
    return tuple(makers)


def _frames_of(folders: Sequence[Path], target: OutputFolder | None) -> Iterator[Path]:
    for folder in folders:
        with _open_part(folder) as part:
            names = [name for name in part.sums() if _FRAME.fullmatch(name)]
        yield from (folder / name for name in names if (folder / name).exists())
    if target is not None:
        yield from (target.path / name for name in target.sums() if _FRAME.fullmatch(name) and (target.path / name).exists())


def _copy(folder: Path, target: OutputFolder, sums: Mapping[str, str]) -> None:
    """Write the files of a part that the folder does not have yet."""
    with _open_part(folder) as part:
        for name, digest in part.sums().items():
            if target.sums().get(name) == digest and target.holds(name):
                continue
            with tell_errors(folder / name):
                data = (folder / name).read_bytes()
            if hashlib.sha256(data).hexdigest() != sums.get(name):
                raise InputError(f"{folder / name}: changed while the parts were gathered; repeat the command")
            target.write(name, data)


@contextmanager
def _open_part(folder: Path) -> Generator[OutputFolder, None, None]:
    part = folder_of(folder)
    with part.open(refusal=None):
        yield part
