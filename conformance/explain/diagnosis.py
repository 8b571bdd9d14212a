# SPDX-License-Identifier: MIT
"""Compare a wrong answer with known mistakes: which of them, planted in the reference, gives the same numbers on the same input."""

from __future__ import annotations

from functools import lru_cache
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.judging.findings import DepartureError, Finding
from conformance.judging.judge import Judge
from conformance.mistakes import of_stage
from conformance.mistakes.planting import Mistake, Variant
from conformance.protocol.port import Outputs

MOST_SECONDS = 20.0
"""Most computing time of one diagnosis; seconds."""
MOST_NAMED = 3
INSIDE = ("history", "encoder", "erm", "decoder")
CONTAINS = {"network": INSIDE, "frame": ("motion_chain", "warp", "holes", "occlusion_warp", "network", *INSIDE)}
ALIKE = 0.99
"""Share of the wrong numbers that a mistake has to explain."""


def diagnose(judge: Judge, finding: Finding) -> str:
    """Name the known mistakes that a wrong answer looks like.

    Returns:
        ``looks like: ...``, the nearest first; or that no known mistake gives these numbers. "" where there is nothing to compare: the
        port gave no answer, or its answer is right by itself and only two of its answers together are wrong.
    """
    if finding.expected is None:
        return ""
    case = finding.case
    try:
        got = judge.run(case.stage, case.inputs, case.weights)
    except DepartureError:
        return ""
    right = judge.right(case.stage, case.inputs, case.weights, got)
    wrong = {name: expected.ratios(got[name]) > 1 for name, expected in right.items()}
    if not any(w.any() for w in wrong.values()):
        return ""
    known, end = _shown_by(case.stage), process_time() + MOST_SECONDS
    found: list[tuple[float, Mistake]] = []
    for tried, mistake in enumerate(known):
        if process_time() > end:
            return _named(found, tried)
        made = _port(mistake).run(case.stage, case.inputs, case.weights)
        if (share := explained(got, made, right, wrong)) >= ALIKE:
            found.append((share, mistake))
    return _named(found, len(known))


def _shown_by(stage: str) -> tuple[Mistake, ...]:
    """Those that large frames show first, since there all take long; then the stage's own, then those of code it shares."""
    inside = [mistake for part in CONTAINS.get(stage, ()) for mistake in of_stage(part)]
    known = dict.fromkeys([*of_stage(stage), *of_stage(stage, shared=True), *inside])
    return tuple(sorted(known, key=lambda mistake: not mistake.large))


@lru_cache(512)
def _port(mistake: Mistake) -> Variant:
    return mistake.port()


def explained(got: Outputs, made: Outputs, right: dict[str, Expected], wrong: dict[str, NDArray[np.bool_]]) -> float:
    """The share of the wrong numbers that a mistake gives too, within twice their bound, or of the others, whichever is smaller."""
    shares = [1.0]
    for name, expected in right.items():
        if made[name].shape != got[name].shape:
            return 0.0
        allowed: Any = 2 * np.asarray(expected.allowed)
        alike = Expected(made[name].astype(np.float64), allowed, vectors=expected.vectors).ratios(got[name]) <= 1
        for where in (wrong[name], ~wrong[name]):
            if where.any():
                shares.append(float(alike[where].mean()))
    return min(shares)


def _named(found: list[tuple[float, Mistake]], tried: int) -> str:
    if not found:
        return f"looks like none of the {tried} mistakes that were compared"
    found.sort(key=lambda each: -each[0])
    return "looks like: " + "; or ".join(mistake.what for _, mistake in found[:MOST_NAMED])
