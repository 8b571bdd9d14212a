# SPDX-License-Identifier: MIT
"""Plans of a frame's computation: ``error_control`` makes them, and ``frame_cache`` executes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from stss_cl.skip.arrival import Tiles


@dataclass(frozen=True)
class InputPlan:
    """Which of the network's inputs to compute.

    Attributes:
        dirty: where; None: everywhere. If nowhere, the frame equals the last one of its kind.
        looking: whether to mark the tiles that then differ.
    """

    dirty: Tiles | None
    looking: bool

    @property
    def nothing(self) -> bool:
        """Whether nothing needs to be computed."""
        return self.dirty is not None and not self.dirty.any()


@dataclass(frozen=True)
class Plan:
    """Which part of the network to run.

    Attributes:
        network: ``changed``: where inputs changed; ``partly``: everywhere, except for the decoder in flat tiles; ``whole``: everywhere.
        check: whether to measure, on a ``whole`` image, the error that leaving out flat tiles would make.
        all_changed: whether looking for changes gained nothing.
        looking: whether changes were looked for.
    """

    network: Literal["changed", "partly", "whole"]
    check: bool
    all_changed: bool
    looking: bool
