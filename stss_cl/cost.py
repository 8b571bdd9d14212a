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
        changed: share of the tiles of 4 x 4 pixels in which something changed; where they are most of the frame, of the pixels whose
            inputs then differed; 1 if nothing was compared.
        network: the part of the network that ran.
    """

    changed: float
    network: Part
