# SPDX-License-Identifier: MIT
"""The skipped share of a run: beside the progress bar, and in a line about the whole run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stss_cl.cost import Cost


class Tally:
    """Counts how much of the network was left out so far."""

    def __init__(self) -> None:
        self._frames = 0
        self._shares = 0.0

    def add(self, cost: Cost | None) -> str:
        """Count a frame; returns the share that had not changed over all frames, as text; "" if none was checked."""
        if cost is not None:
            self._frames += 1
            self._shares += 0.0 if cost.network == "none" else cost.changed
        return "" if not self._frames else f"skipped {1 - self._shares / self._frames:.0%}"


def describe_costs(costs: Sequence[Cost]) -> str:
    """One line that says how much of the network a run computed; ``costs`` are those of its frames."""
    whole, part, none = ([cost for cost in costs if cost.network == network] for network in ("whole", "changed", "none"))
    parts = [f"{len(whole)} whole"] if whole else []
    if part:
        parts.append(f"{len(part)} in part ({np.mean([cost.changed for cost in part]):.0%} of the frame had changed)")
    parts += [f"{len(none)} not at all"] if none else []
    return f"network computed: {', '.join(parts)}"
