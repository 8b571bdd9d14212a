# SPDX-License-Identifier: MIT
"""Decide how much of a frame is computed: whether to look for changes, and which part of the network to run.

Plan, execute, learn: ``ChangeControl`` plans, ``stss_cl.skip.frame_cache`` executes the plan, ``learn`` takes the result.
"""

from __future__ import annotations

from stss_cl.cost import Part

MOST_CHANGED = 0.75
"""If a larger share of the network's inputs changed, the whole network is computed, since finding the unchanged rest would not pay."""
PATIENCE, AGAIN, REST = 8, 4, 48
"""After ``PATIENCE`` frames in a row, SF and EF alike, in which all was computed, the stream does not look for changes until the
``REST``-th: looking costs time, and a moving camera seldom stops. From then on ``AGAIN`` such frames in a row suffice. The first SF and
the first EF after the pause are computed whole, since their changes are unknown."""


class ChangeControl:
    """Decides which parts of a stream's frames are computed, SF and EF.

    Attributes:
        frames_unlooked: frames left to be computed without looking for changes, this one included.
    """

    def __init__(self) -> None:
        self.frames_unlooked = self._frames_all_changed = 0

    def begin(self) -> bool:
        """Begin the next frame; returns whether to look for its changes."""
        self.frames_unlooked = max(0, self.frames_unlooked - 1)
        return not self.frames_unlooked

    def plan(self, changed: float) -> Part:
        """Plan the part of the network to run; ``changed``: the share of its inputs that changed, 1 if they were not compared."""
        return "whole" if changed > MOST_CHANGED else "changed"

    def learn(self, network: Part) -> None:
        """Learn from the run, if the stream looked for changes: in vain if all was computed."""
        if self.frames_unlooked:
            return
        self._frames_all_changed = self._frames_all_changed + 1 if network == "whole" else 0
        if self._frames_all_changed >= PATIENCE:
            self._frames_all_changed, self.frames_unlooked = PATIENCE - AGAIN, REST
