# SPDX-License-Identifier: MIT
"""The header of an EXR file as a list of attributes with their lengths, looked at before a library takes memory for them."""

from __future__ import annotations

import struct
from typing import BinaryIO

MOST_HEADER = 32 << 20
"""Most bytes of all attributes; the largest known ones are manifests of Cryptomatte, of a few MiB."""
MOST_ATTRIBUTES = 100_000
_MOST_NAME = 256


def header_bytes(file: BinaryIO) -> int:
    """The number of bytes that the attributes of an EXR file claim; counting stops once they exceed `MOST_HEADER`.

    A file that is no EXR, or ends within its header, gives the entries before that: the library reports the fault.

    Args:
        file: just behind its magic number; afterwards behind the headers.

    Source: OpenEXR File Layout, "Header Attributes": name, type, length and value, each header ended by an empty name; those of a
    multi-part file one after the other, ended by an empty header.
    """
    flags = file.read(4)
    multipart, total, empty = bool(len(flags) == 4 and flags[1] & 0x10), 0, False
    for _ in range(MOST_ATTRIBUTES):
        name = _word(file)
        if not name:
            if name is None or empty or not multipart:
                break
            empty = True  # the end of a header; of the last one if another empty name follows
            continue
        empty = False
        if _word(file) is None or len(length := file.read(4)) < 4:
            break
        total += struct.unpack("<I", length)[0]
        if total > MOST_HEADER:
            break
        file.seek(struct.unpack("<I", length)[0], 1)
    else:
        return MOST_HEADER + 1
    return total


def ends_early(file: BinaryIO, size: int) -> bool:
    """Whether a part of an EXR file's pixels would lie behind its end, as in a copy that was stopped; then no pixel need be read.

    Args:
        file: just behind its headers.
        size: bytes of the file.

    Source: OpenEXR File Layout, "Offset Tables": one place of 8 bytes for each chunk, all before the first chunk.
    """
    at, first, last = file.tell(), size, 0
    while at < first and len(entry := file.read(8)) == 8:
        (place,) = struct.unpack("<Q", entry)
        if place:  # 0: never written
            first, last = min(first, place), max(last, place)
        at += 8
    return last >= size


def _word(file: BinaryIO) -> bytes | None:
    """A text up to its zero; None where there is none, or it is too long."""
    start = file.tell()
    word, zero, _ = file.read(_MOST_NAME).partition(b"\0")
    if not zero:
        return None
    file.seek(start + len(word) + 1)
    return word
