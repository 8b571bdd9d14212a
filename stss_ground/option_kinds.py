# SPDX-License-Identifier: MIT
"""Kinds of option that need nothing of the project: the judge is installed without the rest.

A kind for files says whether they are read or written, so every command declares both. A `Subcommand` compares all of them before it
begins.
"""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path
from typing import Any

import click

from stss_ground.shell import split_words

MAX_SEED = 2**32 - 1
MAX_SECONDS = 7 * 24 * 3600

_FILMS_AND_PICTURES = {".avi", ".exr", ".jpeg", ".jpg", ".mkv", ".mov", ".mp4", ".mxf", ".png", ".tif", ".tiff", ".webm"}


class _Place(click.Path):
    """A path that is not empty: a script's variable that is not set would otherwise mean the current folder."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path; an empty one is the user's mistake."""
        return super().convert(_require_name(self, value, param, ctx), param, ctx)


class ReadPath(_Place):
    """A file or a folder that is read."""

    def reads(self, value: Path) -> list[Path]:
        """The files that are read."""
        return [value]


class ReadName(click.ParamType):  # pyrefly: ignore[implicit-any-type-argument]
    """A file that is read, or the name of one that comes with stss."""

    name = "text"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The text as it is; an empty one is the user's mistake."""
        return str(_require_name(self, value, param, ctx))

    def reads(self, value: str) -> list[Path]:
        """The path that is read, if it is a file."""
        return [Path(value)]


class Program(ReadName):
    """A command line, whose program and arguments may be files: all of them count as read."""

    def reads(self, value: str) -> list[Path]:
        """The files among its words, and among the words of a word, as in ``sh -c "./port --table=t.csv"``."""
        paths: list[Path] = []
        for word in _words(value):
            for part in (word, *re.split(r"[=:,;]", word), *(_words(word) if word != value else ())):
                paths += [Path(place) for place in (part, shutil.which(part) if part else None) if place]
        return paths


class WrittenFile(_Place):
    """A file that is written, or replaced."""


class WrittenFolder(_Place):
    """A folder that files are written into. The command compares them with its inputs: only it knows their names."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path; a new one that is named like a file is the user's mistake: it would become a folder of that name."""
        path = super().convert(value, param, ctx)
        if path.suffix.lower() in _FILMS_AND_PICTURES and not path.is_dir():
            self.fail(f"expected a folder for frames, found the name of a file, {path.name}", param, ctx)
        return path


class Number(click.FloatRange):
    """A number within a range, never NaN or infinite; ``click.FloatRange`` takes both."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Parse; a wrong one is the user's mistake."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"expected a finite number, got {value!r}", param, ctx)
        return number


class Names(click.ParamType):  # pyrefly: ignore[implicit-any-type-argument]
    """``a,b,c``; empty for none."""

    name = "a,b"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """Split at commas, without the spaces around."""
        return value if isinstance(value, tuple) else tuple(name for name in map(str.strip, str(value).split(",")) if name)


class Size(click.ParamType):  # pyrefly: ignore[implicit-any-type-argument]
    """``WIDTHxHEIGHT``, as (height, width)."""

    name = "WxH"

    def __init__(self, most_side: int, most_pixels: int | None = None):
        self._most_side, self._most_pixels = most_side, most_pixels or most_side**2

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Parse; a wrong size is the user's mistake."""
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"([1-9][0-9]{0,5})x([1-9][0-9]{0,5})", str(value))
        width, height = (int(match[1]), int(match[2])) if match else (0, 0)
        if not 1 <= width * height <= self._most_pixels or max(width, height) > self._most_side:
            most = f"{self._most_side} a side and {self._most_pixels} pixels"
            self.fail(f"expected width x height such as 1280x720, at most {most}, got {value!r}", param, ctx)
        return height, width


def _require_name(kind: click.ParamType[Any], value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
    if value == "":
        kind.fail("expected a name, got an empty text; is a variable of a script not set?", param, ctx)
    if isinstance(param, click.Option) and isinstance(value, str) and value.startswith("="):  # of -o=out
        kind.fail(f"expected a name, got {value}; write {param.opts[-1]}{value}, or {param.opts[0]} {value[1:]}", param, ctx)
    return value


def _words(text: str) -> list[str]:
    try:
        return split_words(text)
    except ValueError:
        return text.split()
