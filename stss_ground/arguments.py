# SPDX-License-Identifier: MIT
"""Check the arguments of the API before use: a wrong type is the caller's mistake, and one line."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from typing import Any

from stss_ground.errors import InputError


def require_kind(name: str, value: Any, kinds: type | tuple[type, ...], expected: str) -> None:
    """Raise InputError unless ``value`` is of one of the types; a bool is no number."""
    if not isinstance(value, kinds) or (
        isinstance(value, bool) and bool not in (kinds if isinstance(kinds, tuple) else (kinds,))
    ):
        raise InputError(f"{name}: expected {expected}, got {type(value).__name__}")


def require_choice(name: str, value: Any, choices: Collection[str]) -> None:
    """Raise InputError unless ``value`` is one of these words."""
    if not isinstance(value, str) or value not in choices:
        got = repr(value) if isinstance(value, str) else type(value).__name__
        raise InputError(f"{name}: expected one of {', '.join(choices)}, got {got}")


def suggest(word: str, names: Iterable[str]) -> str:
    """``; did you mean motion.X?``: the names most like a wrong word, whatever their case; "" if none is like it."""
    spellings = {name.lower(): name for name in names}
    near = [spellings[match] for match in get_close_matches(word.lower(), spellings)]
    return f"; did you mean {' or '.join(near)}?" if near else ""


def listing(names: Collection[str], most: int = 24) -> str:
    """The first ``most`` of these names, and how many there are in all: a file of a stranger may have a thousand."""
    more = f", ... ({len(names)} in all)" if len(names) > most else ""
    return ", ".join(islice(names, most)) + more


def path_of(name: str, value: Any) -> Path:
    """A path that the caller gave as text or as a path.

    Raises:
        InputError: it is neither, is empty, or has a character that no file's name has.
    """
    require_kind(name, value, (str, os.PathLike), "a path")
    if not os.fspath(value):
        raise InputError(f"{name}: expected a path, got an empty text")
    path = Path(value)
    if "\0" in str(path):
        raise InputError(f"{name}: {str(path)!r}: expected a path without the character NUL")
    return path
