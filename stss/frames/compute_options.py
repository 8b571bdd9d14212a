# SPDX-License-Identifier: MIT
"""A way to compute frames: what the user may trade for time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Setting:
    """What ``stss.frames.backends.open_backend`` takes; ``max_error`` in output units, for ``bounded``."""

    precision: Literal["float32", "float32-direct", "half"]
    skip: Literal["off", "exact", "bounded"]
    max_error: float = 0.0

    @property
    def name(self) -> str:
        """As in tables."""
        bound = f" {self.max_error * 255:g}/255" if self.skip == "bounded" else ""
        return f"{self.precision} {self.skip}{bound}"

    @property
    def options(self) -> str:
        """As the user would type it."""
        bound = f" --max-error {self.max_error * 255:g}/255" if self.max_error else ""
        return f"--precision {self.precision} --skip {self.skip}{bound}"
