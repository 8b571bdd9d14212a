# SPDX-License-Identifier: MIT
"""Kinds of option that need nothing of the project: the judge is installed without the rest."""

from __future__ import annotations

import math
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
