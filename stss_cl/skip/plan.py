# SPDX-License-Identifier: MIT
"""What is to be computed of a frame, and what that showed: data between ``error_control``, which decides, and ``frame_cache``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from stss_cl.skip.partial_network import Level
from stss_cl.skip.uploaded_frames import Tiles

Check = Literal["flat tiles", "both ways"]
"""How a frame shows what leaving out makes of it: what flat tiles lack can be seen in the whole image, all else needs another one."""


class Choice(NamedTuple):
    """What is left out of a frame in which nearly everything changed, and how it is checked; None: not at all."""

    level: Level
    check: Check | None


@dataclass(frozen=True)
class InputPlan:
    """What of a frame's inputs is computed.

    Attributes:
        dirty: where; None: everywhere. Nowhere: the frame is the last one of its kind.
        looking: whether what came to differ is marked.
        tolerance: inputs that differ by no more from what they were stay.
        older: whether the two older colour frames are read, by weights that read them.
        choice: what is left out of the network; None: ``changed`` decides.
    """

    dirty: Tiles | None
    looking: bool
    tolerance: float
    older: bool
    choice: Choice | None

    @property
    def nothing(self) -> bool:
        """Whether nothing is to be computed."""
        return self.dirty is not None and not self.dirty.any()


@dataclass(frozen=True)
class Plan:
    """What of the network is run.

    Attributes:
        network: ``changed``: where inputs changed; ``partly``: everywhere, but for what ``choice`` leaves out; ``whole``: everywhere,
            and what it leaves out is checked.
        tolerance: of ``changed``.
        choice: of ``partly`` and ``whole``.
        recheck: whether the frame is then computed once more, whole, to see what tolerances made of it.
        all_changed: whether there was nothing to gain from looking for changes.
        looking: whether anybody looked.
    """

    network: Literal["changed", "partly", "whole"]
    tolerance: float
    choice: Choice
    recheck: bool
    all_changed: bool
    looking: bool


@dataclass(frozen=True)
class Outcome:
    """The departures that were found: of what ``Plan.choice`` left out, and of what tolerances kept; None: not looked for."""

    left_out: float | None = None
    kept: float | None = None
