# SPDX-License-Identifier: MIT
"""Read TOML files and check every key: its type, its value, and that it is known."""

from __future__ import annotations

import math
import re
import reprlib
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, cast

from stss_ground.arguments import suggest
from stss_ground.regular_file import read_regular

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


MAX_BYTES = 64 << 10
"""Largest size of a file; ours have three thousand bytes."""


MAX_DOTS = 200
"""Most dots in a line; the parser's time grows with the cube of a dotted key's length."""


def read_toml(path: Path, error: Callable[[str], Exception]) -> Table:
    """Read the top table of a file.

    Args:
        path: a regular file of at most `MAX_BYTES`.
        error: makes the exception to raise from a message, here and in the table's methods.
    """
    try:
        text = read_regular(path, MAX_BYTES).decode("utf-8-sig")  # as editors of Windows begin a file
        if any(line.count(".") > MAX_DOTS for line in text.splitlines()):
            raise error(f"{path}: cannot be read as TOML: expected at most {MAX_DOTS} dots in a line")
        return Table(path, "", error, tomllib.loads(text))
    except OSError as found:
        raise error(f"{path}: cannot be read as TOML: {found.strerror}") from None
    except RecursionError:
        raise error(f"{path}: cannot be read as TOML: nested too deeply") from None
    except ValueError as found:  # not UTF-8, not TOML, or a number of more digits than Python converts
        raise error(f"{path}: cannot be read as TOML: {' '.join(str(found).split())}") from None


class Table:
    """A TOML table whose keys are taken one by one; a key that is left over at the end is unknown."""

    def __init__(self, path: Path | str, prefix: str, error: Callable[[str], Exception], table: dict[str, Any]):
        self.path, self.prefix, self.error, self.rest = path, prefix, error, dict(table)

    def fail(self, key: str, expected: str, value: object) -> Exception:
        """The error to raise for a key."""
        got = "nothing" if value is None else _format(value)
        return self.error(f"{self.path}: {self.prefix}{key}: expected {expected}, found {got}")

    def take(self, key: str, expected: str, kind: type | tuple[type, ...]) -> Any:
        """The value of a key, of the given type."""
        value = self.rest.pop(key, None)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise self.fail(key, expected, value)
        return value

    def text(self, key: str) -> str:
        """The value of a key that must be one line of text, not empty."""
        value = cast(str, self.take(key, "text", str))
        if not value or not value.isprintable():
            raise self.fail(key, "one line of text", value)
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """The value of a key that must be one line of text, or a list of them, none empty."""
        value = self.take(key, "text, or a list of texts", (str, list))
        texts = cast("list[Any]", value if isinstance(value, list) else [value])
        if not texts or not all(isinstance(text, str) and text and text.isprintable() for text in texts):
            raise self.fail(key, "one line of text, or a list of them", value)
        return tuple(texts)

    def choice(self, key: str, choices: Collection[str]) -> Any:
        """The value of a key that must be one of ``choices``."""
        value = self.rest.pop(key, None)
        if value not in choices:
            raise self.fail(key, f"one of {', '.join(choices)}", value)
        return value

    def number(self, key: str, *, positive: bool = False, infinite: bool = False) -> float:
        """The value of a key that must be a number, finite unless ``infinite``."""
        expected = "a number > 0" if positive else "a number"
        number = self.take(key, expected, (int, float))
        value = _float(number)
        if not (math.isfinite(value) or (infinite and math.isinf(value))) or (positive and value <= 0):
            raise self.fail(key, expected, number)
        return value

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        """The value of a key that must be a list of ``count`` finite numbers."""
        expected = f"{count} numbers"
        values = cast(list[Any], self.take(key, expected, list))
        if len(values) != count or not all(type(x) in (int, float) and math.isfinite(_float(x)) for x in values):
            raise self.fail(key, expected, values)
        return tuple(float(x) for x in values)

    def names(self, key: str, count: int) -> tuple[tuple[str, ...], ...]:
        """The value of a key that must be a list of lists of ``count`` names."""
        expected = f"a list of lists of {count} names each"
        values = cast(list[Any], self.take(key, expected, list))
        for value in values:
            if not isinstance(value, list) or len(cast(list[Any], value)) != count:
                raise self.fail(key, expected, values)
            if not all(isinstance(name, str) and name for name in cast(list[Any], value)):
                raise self.fail(key, expected, values)
        return tuple(tuple(value) for value in values)

    def table(self, key: str, *, optional: bool = False) -> Table:
        """The table of a key; an empty one if it is ``optional`` and missing."""
        value = {} if optional and key not in self.rest else self.take(key, "a table", dict)
        self.rest.pop(key, None)
        return Table(self.path, f"{self.prefix}{key}.", self.error, value)

    def whole(self, key: str, most: int, *, divides: int | None = None) -> int:
        """The value of a key that must be a whole number from 1 to ``most``, and a divisor of ``divides``."""
        value = self.rest.pop(key, None)
        if type(value) is not int or not 1 <= value <= most:
            raise self.fail(key, f"a whole number from 1 to {most}", value)
        if divides is not None and divides % value:
            raise self.fail(key, f"a divisor of {divides}", value)
        return value

    def flag(self, key: str) -> bool:
        """The value of a key that must be true or false; false if it is missing."""
        return key in self.rest and cast(bool, self.take(key, "true or false", bool))

    def only(self, keys: str) -> None:
        """Raise the error if there is a key that ``keys`` does not list; before a key is taken, or a misspelt one counts as missing."""
        names = {*re.findall(r"\w+", keys)} - {"and", "the", "tables"}
        for key in self.rest:
            if key not in names:
                raise self.error(f"{self.path}: {self.prefix}{key}: unknown key; known are {keys}{suggest(key, names)}")

    def end(self) -> None:
        """Raise the error if a key is left over."""
        for key in self.rest:
            raise self.error(f"{self.path}: {self.prefix}{key}: unknown key")


def _float(value: float) -> float:
    """``value`` as a float; NaN for a whole number that is too large for one."""
    try:
        return float(value)
    except OverflowError:
        return math.nan


class _Short(reprlib.Repr):
    """Shows values from files of unknown origin, cut short; ``repr`` itself fails for nested tables and long whole numbers."""

    def repr_int(self, x: int, level: int) -> str:
        del level
        return repr(x) if abs(x) < 10**40 else f"a whole number of {x.bit_length()} bits"


def _format(value: object) -> str:
    short = _Short()
    short.maxstring = short.maxother = 80
    return " ".join(short.repr(value).split())  # an array's has several lines
