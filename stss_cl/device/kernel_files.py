# SPDX-License-Identifier: MIT
"""What PoCL keeps of compiled kernels, looked at before PoCL does: it ends the process where one of its files is damaged."""

from __future__ import annotations

import atexit
import hashlib
import os
import re
import struct
from collections.abc import Iterator, Mapping
from functools import cache, partial
from pathlib import Path

from stss_cl.device.caches import read, store
from stss_ground.terminal import echo

SUMS = "stss.sha256"
"""Name of the list in the cache: the SHA-256 of each file that a process left which came to its end."""
MOST_BYTES = 64 << 20
_LINE = re.compile(r"([0-9a-f]{64})  (.+)")


@cache
def mend(folder: Path) -> None:
    """Remove the files of PoCL's cache that are not as they were left, so that PoCL builds them anew, and say so; once in a process.

    A file that is in the list must have its checksum. Another one, of a process that was killed, must be whole by what it says itself.
    What this process builds comes into the list at its end.
    """
    listed, found = _read(folder), dict[str, str]()
    damaged: list[Path] = []
    for path in _files(folder):
        name, data = path.relative_to(folder).as_posix(), read(path, MOST_BYTES) or b""
        if listed[name] == hashlib.sha256(data).hexdigest() if name in listed else is_whole(path.suffix, data):
            found[name] = listed.get(name, "")
        else:
            path.unlink(missing_ok=True)
            damaged.append(path)
    if damaged:
        echo(f"kernel cache {folder}: {len(damaged)} of {len(damaged) + len(found)} files are damaged, and built anew", err=True)
    if listed.keys() - found.keys():
        _write(folder, {name: digest for name, digest in found.items() if digest})
    atexit.register(partial(_remember, folder, {name for name, digest in found.items() if digest}))


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
    """Whether the table of sections, at the end of an ELF file of 64 bits, is there; of another format, whether there is anything."""
    if data[:5] != b"\x7fELF\x02":
        return any(data[:4]) and data[:4] != b"\x7fELF"
    order = "<" if data[5] == 1 else ">"
    (sections,) = struct.unpack_from(f"{order}Q", data, 40)
    size, number = struct.unpack_from(f"{order}HH", data, 58)
    return 0 < sections + size * number <= len(data)


def _remember(folder: Path, known: set[str]) -> None:
    """Add the files that have come since to the list, which another process may have changed."""
    new = {path.relative_to(folder).as_posix(): path for path in _files(folder)}
    found = {name: data for name, path in new.items() if name not in known and (data := read(path, MOST_BYTES))}
    whole = {name: hashlib.sha256(data).hexdigest() for name, data in found.items() if is_whole(Path(name).suffix, data)}
    if whole:
        _write(folder, _read(folder) | whole)


def _files(folder: Path) -> Iterator[Path]:
    """The bitcode and the kernels of a cache, each below a folder of its program."""
    for place, _, names in os.walk(folder):
        yield from (Path(place, name) for name in names if name.endswith((".bc", ".so")))


def _read(folder: Path) -> dict[str, str]:
    text = (read(folder / SUMS, MOST_BYTES) or b"").decode(errors="replace")
    return {match[2]: match[1] for line in text.splitlines() if (match := _LINE.fullmatch(line))}


def _write(folder: Path, sums: Mapping[str, str]) -> None:
    store(folder / SUMS, "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items())).encode())
