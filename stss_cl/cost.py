# SPDX-License-Identifier: MIT
"""The cost of a frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Part = Literal["none", "changed", "whole"]
"""The part of the network that runs: ``none``, since the frame equals the last one of its kind; ``changed``: the tiles that changes of
the inputs reach; ``whole``."""


@dataclass(frozen=True)
class Cost:
    """The cost of a frame.

    Attributes:
        changed: share of the tiles of 4 x 4 pixels that changed; if these are most of the frame, the share of the pixels whose inputs
            differed; 1 if nothing was compared.
        network: the part of the network that ran.
    """

    changed: float
    network: Part
