# SPDX-License-Identifier: MIT
"""The arguments of kernels, read from their source.

A driver knows the names of arguments only on request, and seldom those of a program that was built from a binary. So they are taken from
the source. The text is not preprocessed: this module reads the few forms in which our kernels declare arguments.
"""

from __future__ import annotations

import re
from collections.abc import Set

_QUALIFIERS = {"global", "local", "constant", "const", "volatile", "restrict"}
_CHOICE = re.compile(
    r"^#ifdef (\w+)\n((?:(?!#).*\n|#define.*\n)*?)(?:#else\n((?:(?!#).*\n|#define.*\n)*?))?#endif\n", re.MULTILINE
)
_GROUP = re.compile(r"^#define (\w+)\(DO\)(.*)", re.MULTILINE)
_STRUCT = re.compile(r"^typedef struct \{\n(.*?)^\} (\w+);", re.MULTILINE | re.DOTALL)


def arguments(text: str, kernel: str, defined: Set[str]) -> list[tuple[str, str]]:
    """Name and type of each argument of a kernel, in order, the type without qualifiers: ``("color", "float*")``.

    Besides plain declarations, ``GROUP(ARGUMENT)`` stands for those that ``#define GROUP(DO) DO(type, name) ...`` lists, all of them
    pointers to global memory; ``#ifdef NAME`` with ``#else`` chooses between lines without further conditions.

    Args:
        text: the source, with its includes.
        kernel: its name.
        defined: the names of the ``-D`` options.

    Raises:
        TypeError: there is no such kernel.
    """
    code = re.sub(r" *//.*|\\\n", "", text)
    code = _CHOICE.sub(lambda choice: choice[2] if choice[1] in defined else choice[3] or "", code)
    declaration = re.search(rf"^kernel\b[^{{;]*?\bvoid {kernel}\(([^{{;]*)\)\s*\{{", code, re.MULTILINE)
    if declaration is None:
        raise TypeError(f"kernel {kernel}: its source does not declare it")
    groups = {name: re.sub(r"DO\((.*?), (\w+)\)", r"\1 *\2,", body) for name, body in _GROUP.findall(code)}
    declared = re.sub(r"(\w+)\(ARGUMENT\)", lambda group: groups[group[1]], declaration[1])
    words = [re.findall(r"\w+|\*", each) for each in declared.split(",")]
    return [(name, "".join(word for word in kind if word not in _QUALIFIERS)) for *kind, name in filter(None, words)]


def structs(text: str) -> dict[str, dict[str, str]]:
    """The structs of a source whose members are all numbers of 32 bits: struct -> members with their types, in order."""
    numbers: dict[str, dict[str, str]] = {}
    for body, name in _STRUCT.findall(text):
        lines = re.sub(r"//.*", "", body).split(";")[:-1]
        members = [re.fullmatch(r"\s*(u?int|float) ([\w,\s]+)", line) for line in lines]
        if all(members):
            numbers[name] = {member: each[1] for each in members if each for member in re.split(r",\s*", each[2])}
    return numbers
