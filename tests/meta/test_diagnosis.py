"""A wrong answer leads to its mistake: the planted one is among those that are named, and nothing is named that does not fit."""

import numpy as np
import pytest

from conformance.explain.diagnosis import diagnose
from conformance.judging.findings import DepartureError
from conformance.judging.judge import Judge
from conformance.mistakes import find
from conformance.mistakes.precision import rounded_at
from conformance.protocol.reference_copy import half, load, returns
from conformance.suite.properties import find_property
from stss.port import ReferencePort
from tests.meta.samples import samples


def said(port, stage):
    """The diagnosis of the first sample that it gets wrong."""
    judge, body = Judge(port), find_property(f"{stage}.agrees_with_the_reference")
    for case in samples(stage):
        try:
            judge.check(body, case.inputs if case.weights is None else (case.inputs, case.weights))
        except DepartureError as error:
            return diagnose(judge, [error.finding])
    return None


NAMED = ["motion_chain_x_sign", "warp_x_sign", "holes_facing_5", "rrm_filled", "occlusion_warp_starts_at_1", "erm_epsilon_inside"]


@pytest.mark.parametrize("name", NAMED)
def test_a_planted_mistake_is_named(name):
    mistake = find(name)
    assert mistake.what in said(mistake.port(), mistake.stage)


def test_what_contains_a_stage_names_its_mistakes():
    mistake = find("history_newest_first")
    assert mistake.what in said(mistake.port(), "network")


@pytest.mark.parametrize("what", ["input", "weights"])
def test_the_place_of_fewer_bits_is_named(what):
    port = load("planted", *rounded_at("latentEncoder.2", what, half))
    assert f"half precision at the {what} of latentEncoder.2" in said(port, "erm")


def test_a_mistake_without_effect_explains_nothing():
    """What is off by less than twice the bound is near to any mistake that changes no number of the case."""
    port = load("planted", returns("warp.warp", lambda result: (result[0] * np.float32(1 + 2.0**-20), result[1])))
    assert "none of the" in said(port, "warp")


def test_the_answers_that_are_right_count_too():
    """A mistake that explains the failure is not named if it were wrong where the port is right."""
    case = samples("warp")[0]
    judge = Judge(find("warp_x_sign").port())
    with pytest.raises(DepartureError) as caught:
        judge.check(find_property("warp.agrees_with_the_reference"), case.inputs)
    assert "to the left" in diagnose(judge, [caught.value.finding])
    judge.answered.append((case, ReferencePort().run("warp", case.inputs)))
    assert "to the left" not in diagnose(judge, [caught.value.finding])


class Odd(ReferencePort):
    """A mistake that nobody has made before."""

    def run(self, stage, inputs, weights=None):
        outputs = super().run(stage, inputs, weights)
        return {name: a + np.float32(0.37) * np.sin(a) if a.dtype.kind == "f" else a for name, a in outputs.items()}


def test_nothing_is_named_that_does_not_fit():
    assert "looks like none of the" in said(Odd(), "warp")


def test_a_right_answer_looks_like_nothing():
    """Where two answers together are wrong, each may be right."""
    judge, case = Judge(Odd()), samples("warp")[0]
    with pytest.raises(DepartureError) as caught:
        judge.check(find_property("warp.agrees_with_the_reference"), case.inputs)
    assert diagnose(Judge(ReferencePort()), [caught.value.finding]) == ""
