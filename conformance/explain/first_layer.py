# SPDX-License-Identifier: MIT
"""The place inside a stage where a wrong answer begins: the first of the port's layers that departs from the reference's."""

from __future__ import annotations

import numpy as np

from conformance.answers.expected import largest
from conformance.answers.network import expect_layers
from conformance.judging.findings import Finding, describe
from conformance.judging.judge import Judge
from conformance.protocol.layers import LAYERS_OF, check_layers
from conformance.protocol.port import Outputs, PortError, error_text, foreign_code
from conformance.protocol.stages import STAGES
from stss_ref.arrays import ArrayError

END_WITH_LAYERS = frozenset(("history", "encoder"))
"""Stages whose outputs are layers: nothing is computed behind them."""


def first_departure(judge: Judge, finding: Finding) -> str:
    """Words on the first layer that departs; empty if the stage has none, or if it is no output that departs, but how sums are rounded."""
    case = finding.case
    specs = LAYERS_OF.get(case.stage, {})
    if not specs or case.weights is None or finding.expected is None or finding.output not in STAGES[case.stage].outputs:
        return ""
    try:
        got = _layers_of(judge, finding)
    except (ArrayError, PortError) as error:
        return f"its layers cannot be read: {error}"
    if not got:
        return "the port returns no layers, so the first that departs cannot be named"
    right = expect_layers(case.stage, judge.exactly(case.inputs, case.stage), case.weights, judge.arithmetic)
    there = [name for name in specs if name in got]
    for i, name in enumerate(there):
        if largest(right[name].closer(got[name]), got[name]) > 1:
            before = f"; the {i} before it are right" if i > 1 else f"; {there[0]} before it is right" if i else ""
            return f"first departs at layer {describe(name, got[name], right[name])}{before}"
    if case.stage in END_WITH_LAYERS and len(there) == len(specs):
        return f"each of the {len(there)} layers is within its own bound, and nothing comes after the last one"
    return f"none of the {len(there)} layers that the port returns departs, so what comes after {there[-1]} does"


def _layers_of(judge: Judge, finding: Finding) -> Outputs:
    """The port's layers by name; empty if it has no such method."""
    case, ask = finding.case, judge.abilities.layers
    if ask is None or case.weights is None:
        return {}
    inputs = {name: array.copy() for name, array in case.inputs.items()}
    try:
        with foreign_code():
            got: Outputs = ask(case.stage, inputs, case.weights.convert(np.copy))
        check_layers(case.stage, got, case.inputs)
    except (ArrayError, PortError):
        raise
    except Exception as error:
        # Its answer may be anything.
        raise PortError(error_text(error)) from error
    return got
