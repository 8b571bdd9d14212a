# SPDX-License-Identifier: MIT
"""Kinds of option that need nothing of the project: the judge is installed without the rest."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import click

PATH = click.Path(path_type=Path)
MAX_SEED = 2**32 - 1
MAX_SECONDS = 7 * 24 * 3600


class Number(click.FloatRange):
    """A number within a range, never NaN or infinite; ``click.FloatRange`` takes both."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Parse; a wrong one is the user's mistake."""
        found = super().convert(value, param, ctx)
        if not math.isfinite(found):
            self.fail(f"expected a finite number, got {value!r}", param, ctx)
        return found


class Names(click.ParamType):  # pyright: ignore[reportMissingTypeArgument]
    """``a,b,c``; empty for none."""

    name = "a,b"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """Split at commas."""
        return value if isinstance(value, tuple) else tuple(name for name in str(value).split(",") if name)


class Size(click.ParamType):  # pyright: ignore[reportMissingTypeArgument]
    """``WIDTHxHEIGHT``, as (height, width)."""

    name = "WxH"

    def __init__(self, most_side: int, most_pixels: int | None = None):
        self._most_side, self._most_pixels = most_side, most_pixels or most_side**2

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Parse; a wrong size is the user's mistake."""
        if isinstance(value, tuple):
            return value
        found = re.fullmatch(r"([1-9][0-9]{0,5})x([1-9][0-9]{0,5})", str(value))
        width, height = (int(found[1]), int(found[2])) if found else (0, 0)
        if not 1 <= width * height <= self._most_pixels or max(width, height) > self._most_side:
            most = f"{self._most_side} a side and {self._most_pixels} pixels"
            self.fail(f"expected width x height such as 1280x720, at most {most}, got {value!r}", param, ctx)
        return height, width
