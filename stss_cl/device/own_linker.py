# SPDX-License-Identifier: MIT
"""A linker for PoCL's objects: it turns one relocatable object of x86-64 into a shared object, on a machine without a linker.

It is a program: ``python own_linker.py -o OUT ... IN.o ...``, as ``ld`` is called; all other options are ignored. PoCL's objects refer
to nothing outside themselves, and only by the distance of two places. So three steps of a linker's work are left: put the sections behind
one another, fill in the distances, and list the functions' names. Everything else ends with status 1 and a line that names it.

Imports nothing but the standard library: it runs once for every kernel.

Source: System V Application Binary Interface, chapters 4 and 5, and its AMD64 supplement.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

PAGE = 0x1000
HEADER, SEGMENT = struct.Struct("<16sHHIQQQIHHHHHH"), struct.Struct("<IIQQQQQQ")
SECTION, SYMBOL, RELOCATION = struct.Struct("<IIQQQQIIQQ"), struct.Struct("<IBBHQQ"), struct.Struct("<QQq")
"""Of an ELF file."""
IDENT = b"\x7fELF\x02\x01\x01".ljust(16, b"\0")
"""64 bits, least significant byte first, version 1."""
RELOCATABLE, SHARED, X86_64 = 1, 3, 62
PROGRAM_BITS, SYMBOLS, RELOCATIONS = 1, 2, 4
WRITABLE, ALLOCATED = 1, 2
DISTANCES = (2, 4)
"""R_X86_64_PC32 and R_X86_64_PLT32: 32 bits, the symbol's address - the place's."""
LOAD, DYNAMIC, STACK = 1, 2, 0x6474E551
MAY_READ, MAY_WRITE, MAY_EXECUTE = 4, 2, 1


class LinkError(Exception):
    """An object that is damaged, or needs a feature that this linker lacks."""


class Section(NamedTuple):
    """An entry of the table of sections."""

    name: int
    kind: int
    flags: int
    address: int
    offset: int
    size: int
    link: int
    info: int
    alignment: int
    entry: int


class Symbol(NamedTuple):
    """An entry of the table of symbols."""

    name: int
    info: int
    other: int
    section: int
    value: int
    size: int


class Relocatable(NamedTuple):
    """A relocatable object; ``names``: of its sections, ``strings``: of its symbols."""

    data: bytes
    sections: list[Section]
    names: bytes
    symbols: list[Symbol]
    strings: bytes

    def name(self, symbol: Symbol) -> str:
        """The symbol's name."""
        return _text(self.strings, symbol.name)

    def is_loaded(self, section: Section) -> bool:
        """Whether it is a part of the shared object. Frame tables are not, since no exception passes a kernel."""
        return section.kind == PROGRAM_BITS and bool(section.flags & ALLOCATED) and _text(self.names, section.name) != ".eh_frame"


def link(data: bytes) -> bytes:
    """Make a shared object of a relocatable one.

    Raises:
        LinkError: it is damaged, or refers to something outside itself, or in another way than by a distance.
    """
    try:
        return _link(_parse(data))
    except (struct.error, IndexError, ValueError, OverflowError) as error:
        raise LinkError(f"damaged object: {error}") from None


def _parse(data: bytes) -> Relocatable:
    ident, kind, machine, _, _, _, table, _, _, _, _, entry, count, names = HEADER.unpack_from(data)
    if ident[:7] != IDENT[:7] or kind != RELOCATABLE or machine != X86_64 or entry != SECTION.size:
        raise LinkError("expected a relocatable object of x86-64")
    sections = [Section(*SECTION.unpack_from(data, table + i * entry)) for i in range(count)]
    tables = [section for section in sections if section.kind == SYMBOLS]
    if len(tables) != 1:
        raise LinkError(f"expected one table of symbols, got {len(tables)}")
    symbols = [Symbol(*SYMBOL.unpack_from(data, at)) for at in _entries(tables[0], SYMBOL)]
    return Relocatable(data, sections, _bytes(data, sections[names]), symbols, _bytes(data, sections[tables[0].link]))


def _link(source: Relocatable) -> bytes:
    sections = {i: section for i, section in enumerate(source.sections) if source.is_loaded(section)}
    contents = {i: _bytes(source.data, section) for i, section in sections.items()}
    for section in source.sections:
        if section.flags & ALLOCATED and section.flags & WRITABLE and section.size:
            raise LinkError("expected no data that can be written to")
    exported = [symbol for symbol in source.symbols if symbol.info >> 4 and symbol.section in sections]
    names = bytearray(1)
    table = bytearray(SYMBOL.size)
    places = _places(HEADER.size + 4 * SEGMENT.size, exported, source, sections)
    for symbol in exported:
        address = places.sections[symbol.section] + symbol.value
        table += SYMBOL.pack(len(names), symbol.info, symbol.other, 1, address, symbol.size)
        names += source.name(symbol).encode() + b"\0"
    # One bucket: a chain from each symbol to the one before it.
    count = len(exported) + 1
    chains = struct.pack(f"<{3 + count}I", 1, count, count - 1, *(max(i - 1, 0) for i in range(count)))
    dynamic = struct.pack(
        "<12Q", 4, places.chains, 5, places.names, 6, places.symbols, 10, len(names), 11, SYMBOL.size, 0, 0
    )  # DT_HASH, DT_STRTAB, DT_SYMTAB, DT_STRSZ, DT_SYMENT, DT_NULL
    image = bytearray(places.dynamic)
    for at, part in ((places.symbols, table), (places.names, names), (places.chains, chains)):
        image[at : at + len(part)] = part
    for i, content in contents.items():
        image[places.sections[i] : places.sections[i] + len(content)] = content
    _relocate(image, source, places.sections)
    # The dynamic section is written to as it is loaded, so it gets a page of its own: a page further on than in the file.
    segments = (
        (LOAD, MAY_READ | MAY_EXECUTE, 0, 0, len(image), PAGE),
        (LOAD, MAY_READ | MAY_WRITE, len(image), len(image) + PAGE, len(dynamic), PAGE),
        (DYNAMIC, MAY_READ | MAY_WRITE, len(image), len(image) + PAGE, len(dynamic), 8),
        (STACK, MAY_READ | MAY_WRITE, 0, 0, 0, 16),
    )
    header = HEADER.pack(
        IDENT, SHARED, X86_64, 1, 0, HEADER.size, 0, 0, HEADER.size, SEGMENT.size, len(segments), SECTION.size, 0, 0
    )
    image[: len(header)] = header
    for i, (kind, flags, offset, address, size, alignment) in enumerate(segments):
        SEGMENT.pack_into(image, HEADER.size + i * SEGMENT.size, kind, flags, offset, address, address, size, size, alignment)
    return bytes(image + dynamic)


class Places(NamedTuple):
    """Where each part lies: the first page of the file is that of the memory, so offsets are addresses but for ``dynamic``."""

    symbols: int
    names: int
    chains: int
    sections: dict[int, int]
    dynamic: int


def _places(first: int, exported: Sequence[Symbol], source: Relocatable, parts: dict[int, Section]) -> Places:
    count = len(exported) + 1
    names = 1 + sum(len(source.name(symbol).encode()) + 1 for symbol in exported)
    sizes = (SYMBOL.size * count, names + -names % 8, 4 * (3 + count))
    symbols, strings, chains, end = accumulate(sizes, initial=first)
    sections: dict[int, int] = {}
    for i, section in parts.items():
        alignment = max(section.alignment, 1)
        if alignment > PAGE:
            raise LinkError(f"expected an alignment of {PAGE} at most, got {alignment}")
        sections[i] = end + -end % alignment
        end = sections[i] + section.size
    return Places(symbols, strings, chains, sections, end + -end % 16)


def _relocate(image: bytearray, source: Relocatable, places: dict[int, int]) -> None:
    """Fill in the distances."""
    for section in source.sections:
        if section.kind != RELOCATIONS or section.info not in places:
            continue
        for at in _entries(section, RELOCATION):
            offset, info, addend = RELOCATION.unpack_from(source.data, at)
            symbol, kind = source.symbols[info >> 32], info & 0xFFFFFFFF
            if kind not in DISTANCES:
                raise LinkError(f"expected relocations {DISTANCES}, got {kind}")
            if symbol.section not in places:
                raise LinkError(f"symbol {source.name(symbol)}: not in this object")
            if not 0 <= offset <= source.sections[section.info].size - 4:
                raise LinkError(f"relocation at {offset}: beyond its section")
            place = places[section.info] + offset
            struct.pack_into("<i", image, place, places[symbol.section] + symbol.value + addend - place)


def _entries(section: Section, entry: struct.Struct) -> range:
    return range(section.offset, section.offset + section.size - entry.size + 1, entry.size)


def _bytes(data: bytes, section: Section) -> bytes:
    if section.offset + section.size > len(data):
        raise LinkError("damaged object: a section ends behind the file")
    return data[section.offset : section.offset + section.size]


def _text(strings: bytes, at: int) -> str:
    return strings[at : strings.index(b"\0", at)].decode()


def main(arguments: Sequence[str]) -> int:
    """Link the one object among the arguments; returns the exit status."""
    objects = [argument for argument in arguments if argument.endswith(".o")]
    try:
        out = arguments[arguments.index("-o") + 1]
        if len(objects) != 1:
            raise LinkError(f"expected one object, got {len(objects)}")
        Path(out).write_bytes(link(Path(objects[0]).read_bytes()))
    except (LinkError, OSError, ValueError, IndexError) as error:
        sys.stderr.write(f"ld of stss: {' '.join(objects)}: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
