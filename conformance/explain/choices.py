# SPDX-License-Identifier: MIT
"""The choice of the weights that wrong frames hang on: with another one, the same frames are right."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from conformance.answers.expected import largest
from conformance.cases.engine_inputs import engine_inputs
from conformance.judging.findings import DepartureError, Finding
from conformance.judging.judge import Judge
from conformance.protocol.port import Case
from conformance.protocol.weights_format import CHOICES


def decisive_choices(judge: Judge, findings: Iterable[Finding]) -> str:
    """Words on the choices with which all wrong frames are right; empty if there are none, or if the stage has no choices.

    A port may compute a stage once more within ``frame``, where that stage's own tests see nothing of it. Small frames may be right by
    chance, so those of engines must be right, too.
    """
    wrong = {id(each.case.inputs): each.case for each in findings if each.case.stage == "frame" and each.expected is not None}
    if not wrong:
        return ""
    others = [Case("frame", *make(np.random.default_rng(0))) for make in engine_inputs("frame")]
    right = [
        f"{name} {value}"
        for name, values in CHOICES.items()
        for value in values
        if all(getattr(case.weights, name) != value for case in wrong.values())
        and all(_is_right(judge, case, name, value) for case in (*wrong.values(), *others))
    ]
    return f"the same frames are right with {', and with '.join(right)}" if right else ""


def _is_right(judge: Judge, case: Case, name: str, value: str) -> bool:
    """Whether the port is right on a case with this value of a choice."""
    assert case.weights is not None
    choice: dict[str, Any] = {name: value}
    weights = replace(case.weights, **choice)
    try:
        got = judge.run(case.stage, case.inputs, weights)
    except DepartureError:
        return False
    right = judge.right(case.stage, case.inputs, weights, got)
    return bool(right) and all(largest(expected.closer(got[name]), got[name]) <= 1 for name, expected in right.items())
