# SPDX-License-Identifier: MIT
"""Check PoCL's cache of compiled kernels before PoCL reads it: at a damaged file PoCL ends the process."""

from __future__ import annotations

import atexit
import hashlib
import os
import re
import struct
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

from stss_cl.device.caches import read, store
from stss_ground.terminal import echo

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

SUMS = "stss.sha256"
"""The cache's list: SHA-256, state and name of each file, written by a process at its end."""
USERS = "stss.lock"
"""Every process that uses the cache holds a lock on this file until it ends, however it ends."""
YOUNG = 300.0
"""Seconds. A file written to within them may not be complete, if another process uses the cache; linking takes a second, or a minute
on a busy machine."""
MOST_BYTES = 64 << 20
BOOT = Path("/proc/sys/kernel/random/boot_id")
"""A text that changes with each start of the system."""
_LINE = re.compile(r"([0-9a-f]{64}) ([0-9a-f]{16}|-) (.+)")


class FileRecord(NamedTuple):
    """The SHA-256 of a file, and its `_state` when it had that."""

    digest: str
    state: str


@cache
def mend(folder: Path) -> None:
    """Remove damaged files of PoCL's cache, so that PoCL builds them anew, and say so; once in a process.

    A file of the list must have its checksum. Any other file, left by a killed process, must be as long as its own header says.
    A file that was read since the system started, and not written to since, is not read again: a cache of hundreds of MiB
    would take seconds. This process adds its own files to the list at its end. It does not touch files that another process may be
    writing: PoCL ends a process whose file disappears while it links.
    """
    is_used, now = _is_used(folder), time.time()
    records, files = _read(folder), dict[str, FileRecord]()
    boot = (read(BOOT, 64) or b"").decode()
    whole, damaged = 0, 0
    for name, entry in _files(folder):
        record, state = records.get(name), _state(entry, boot)
        if record is not None and record.state == state != "-":
            files[name] = record
            continue
        data = read(Path(entry.path), MOST_BYTES) or b""
        if record is not None and record.digest == hashlib.sha256(data).hexdigest():
            files[name] = FileRecord(record.digest, state)
        elif record is None and is_whole(Path(name).suffix, data):
            whole += 1
        elif not (is_used and _write_time(entry) > now - YOUNG):
            Path(entry.path).unlink(missing_ok=True)
            damaged += 1
    if damaged:
        total = damaged + whole + len(files)
        echo(f"kernel cache {folder}: {damaged} of {total} files are damaged and are built again", err=True)
    if records != files:
        _write(folder, files)
    atexit.register(partial(_remember, folder, set(files), boot))


def _is_used(folder: Path) -> bool:
    """Whether another process uses the cache; from now on this one does, too. False if there are no locks."""
    is_used = False
    with suppress(OSError):
        if fcntl is not None:
            lock = _lock(folder)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                is_used = True
            fcntl.flock(lock, fcntl.LOCK_SH)
    return is_used


@cache
def _lock(folder: Path) -> int:
    """The file of the locks, open until the process ends."""
    return os.open(folder / USERS, os.O_RDONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)


def _write_time(entry: os.DirEntry[str]) -> float:
    """The time of the last write to a file, in seconds; 0 if the file is gone."""
    try:
        return entry.stat(follow_symlinks=False).st_mtime
    except OSError:
        return 0.0


def is_whole(suffix: str, data: bytes) -> bool:
    """Whether a file is as long as its own tables say: LLVM's bitcode, or a shared object."""
    try:
        return _bitcode_ends(data) if suffix == ".bc" else _object_ends(data)
    except struct.error:
        return False


def _bitcode_ends(data: bytes) -> bool:
    """Whether the blocks of bitcode follow each other to its very end (https://llvm.org/docs/BitCodeFormat.html)."""
    at = 4
    while at < len(data):
        (head,) = struct.unpack_from("<I", data, at)
        # Abbreviation width 2: ENTER_SUBBLOCK is 1; then the block's number in groups of 8 bits, which all of them fit, the width within
        # it in groups of 4, and the number of its words, on a boundary of 32 bits.
        if head & 3 != 1:
            return False
        (words,) = struct.unpack_from("<I", data, at + 4)
        at += 8 + 4 * words
    return data[:4] == b"BC\xc0\xde" and at == len(data) > 4


def _object_ends(data: bytes) -> bool:
    """Whether the segments of an ELF file of 64 bits are there, and its table of sections; of another format, whether there is anything.

    The table comes last, but our own linker writes none.
    """
    if data[:5] != b"\x7fELF\x02":
        return any(data[:4]) and data[:4] != b"\x7fELF"
    order = "<" if data[5] == 1 else ">"
    segments, sections = struct.unpack_from(f"{order}2Q", data, 32)
    segment, count, section, number = struct.unpack_from(f"{order}4H", data, 54)
    parts = (struct.unpack_from(f"{order}8xQ16xQ", data, segments + i * segment) for i in range(count))
    end = max((sections + section * number, *(offset + size for offset, size in parts)))
    return 0 < end <= len(data)


def _remember(folder: Path, records: set[str], boot: str) -> None:
    """Add new files to the list, which another process may have changed."""
    new: dict[str, FileRecord] = {}
    for name, entry in _files(folder):
        if name not in records:
            state = _state(entry, boot)
            data = read(Path(entry.path), MOST_BYTES)
            if data and is_whole(Path(name).suffix, data):
                new[name] = FileRecord(hashlib.sha256(data).hexdigest(), state)
    if new:
        _write(folder, _read(folder) | new)


def _files(folder: Path, below: str = "") -> Iterator[tuple[str, os.DirEntry[str]]]:
    """The bitcode and the kernels of a cache, each below a folder of its program, by their names in it."""
    with suppress(OSError), os.scandir(folder / below) as entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                yield from _files(folder, f"{below}{entry.name}/")
            elif entry.name.endswith((".bc", ".so")):
                yield f"{below}{entry.name}", entry


def _state(entry: os.DirEntry[str], boot: str) -> str:
    """A text that changes when a file is written to, and when the system starts again, since the last writes may be lost then; or "-"."""
    try:
        status = entry.stat(follow_symlinks=False)
    except OSError:
        return "-"
    what = f"{boot} {status.st_ino} {status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}"
    return hashlib.sha256(what.encode()).hexdigest()[:16] if boot else "-"


def _read(folder: Path) -> dict[str, FileRecord]:
    text = (read(folder / SUMS, MOST_BYTES) or b"").decode(errors="replace")
    return {match[3]: FileRecord(match[1], match[2]) for line in text.splitlines() if (match := _LINE.fullmatch(line))}


def _write(folder: Path, files: Mapping[str, FileRecord]) -> None:
    store(folder / SUMS, "".join(f"{digest} {state} {name}\n" for name, (digest, state) in sorted(files.items())).encode())
