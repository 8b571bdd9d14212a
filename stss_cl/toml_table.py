# SPDX-License-Identifier: MIT
"""TOML files whose every key is checked: its type, its value, and that it is known."""

from __future__ import annotations

import math
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Any, cast

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]


def read_toml(path: Path, error: type[Exception]) -> Table:
    """The top table of a file.

    Args:
        path: the file.
        error: what to raise where the file cannot be read, is not TOML, or has a wrong value.
    """
    try:
        return Table(path, "", error, tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as fault:
        raise error(f"{path}: cannot be read as TOML: {' '.join(str(fault).split())}") from fault


class Table:
    """A TOML table whose keys are taken one by one; what is left over at the end is unknown."""

    def __init__(self, path: Path, prefix: str, error: type[Exception], table: dict[str, Any]):
        self.path, self.prefix, self.error, self.rest = path, prefix, error, dict(table)

    def fail(self, key: str, expected: str, found: object) -> Exception:
        """The error to raise for a key."""
        shown = "nothing" if found is None else repr(found)
        return self.error(f"{self.path}: {self.prefix}{key}: expected {expected}, found {shown}")

    def take(self, key: str, expected: str, kind: type | tuple[type, ...]) -> Any:
        """The value of a key, of the given type."""
        value = self.rest.pop(key, None)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise self.fail(key, expected, value)
        return value

    def text(self, key: str) -> str:
        """One line of text, not empty."""
        value = cast(str, self.take(key, "text", str))
        if not value or not value.isprintable():
            raise self.fail(key, "one line of text", value)
        return value

    def choice(self, key: str, choices: Collection[str]) -> Any:
        """One of a few words."""
        value = self.rest.pop(key, None)
        if value not in choices:
            raise self.fail(key, f"one of {', '.join(choices)}", value)
        return value

    def number(self, key: str, *, positive: bool = False, infinite: bool = False) -> float:
        """A number, finite unless said."""
        expected = "a number > 0" if positive else "a number"
        value = float(self.take(key, expected, (int, float)))
        if math.isnan(value) or (math.isinf(value) and not infinite) or (positive and value <= 0):
            raise self.fail(key, expected, value)
        return value

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        """A list of so many finite numbers."""
        expected = f"{count} numbers"
        values = cast(list[Any], self.take(key, expected, list))
        if len(values) != count or not all(type(x) in (int, float) and math.isfinite(x) for x in values):
            raise self.fail(key, expected, values)
        return tuple(float(x) for x in values)

    def names(self, key: str, count: int) -> tuple[tuple[str, ...], ...]:
        """A list of lists of so many names."""
        expected = f"a list of lists of {count} names each"
        values = cast(list[Any], self.take(key, expected, list))
        for value in values:
            if not isinstance(value, list) or len(cast(list[Any], value)) != count:
                raise self.fail(key, expected, values)
            if not all(isinstance(name, str) and name for name in cast(list[Any], value)):
                raise self.fail(key, expected, values)
        return tuple(tuple(value) for value in values)

    def table(self, key: str, *, optional: bool = False) -> Table:
        """A table within this one."""
        value = {} if optional and key not in self.rest else self.take(key, "a table", dict)
        self.rest.pop(key, None)
        return Table(self.path, f"{self.prefix}{key}.", self.error, value)

    def end(self, known: str) -> None:
        """Raise the error if a key is left over."""
        for key in self.rest:
            raise self.error(f"{self.path}: {self.prefix}{key}: unknown key; known are {known}")
