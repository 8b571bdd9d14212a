# SPDX-License-Identifier: MIT
"""What is to be computed of a frame: data between ``error_control``, which decides, and ``frame_cache``, which executes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from stss_cl.skip.uploaded_frames import Tiles


@dataclass(frozen=True)
class InputPlan:
    """What of a frame's inputs is computed.

    Attributes:
        dirty: where; None: everywhere. Nowhere: the frame is the last one of its kind.
        looking: whether what came to differ is marked.
    """

    dirty: Tiles | None
    looking: bool

    @property
    def nothing(self) -> bool:
        """Whether nothing is to be computed."""
        return self.dirty is not None and not self.dirty.any()


@dataclass(frozen=True)
class Plan:
    """What of the network is run.

    Attributes:
        network: ``changed``: where inputs changed; ``partly``: everywhere, but for the decoder's flat tiles; ``whole``: everywhere.
        check: whether the image, which is ``whole``, shows what leaving out flat tiles would have made of it.
        all_changed: whether there was nothing to gain from looking for changes.
        looking: whether anybody looked.
    """

    network: Literal["changed", "partly", "whole"]
    check: bool
    all_changed: bool
    looking: bool
