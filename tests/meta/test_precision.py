"""Fewer bits at one place of the network are found, by all numbers of an output together, and no right port comes near."""

import numpy as np
import pytest

from conformance.answers.expected import Expected
from conformance.judging.findings import DepartureError, describe
from conformance.judging.judge import RMS, TIERS, Judge
from conformance.mistakes.precision import rounded_at
from conformance.protocol.reference_copy import half, load
from conformance.suite.properties import find_test
from tests.meta import right_ports as others
from tests.tiers import thorough

FAINT = [("erm", "KEncoder.4", "output"), ("encoder", "down3.downsample", "input")]
"""Half here is within the bound of every number of the quick tier's cases."""
NEAR = 1 / 3
"""No right port comes nearer to the limit."""


def worst(port, stage):
    judge = Judge(port, TIERS["quick"], shrink=False)
    test = find_test(f"{stage}.agrees_with_the_reference")
    judge.check(test.property, *test.source.cases(judge))
    return judge.record.worst


@pytest.mark.parametrize(("stage", "layer", "what"), FAINT)
def test_half_at_one_place_is_found_without_luck(stage, layer, what):
    with pytest.raises(DepartureError, match=r"rms / bound .* though error / bound is at most 0\."):
        worst(load("planted", *rounded_at(layer, what, half)), stage)


@pytest.mark.parametrize(("name", "stage"), [thorough("in_order", "frame"), ("fma", "history"), ("half", "erm")])
def test_no_right_port_comes_near(name, stage):
    """Those that come nearest."""
    ratios = {output: ratio for output, ratio in worst(others.port(name), stage).items() if output.endswith(RMS)}
    assert ratios
    assert 0 < max(ratios.values()) < NEAR


def test_the_limit_is_of_all_numbers_together():
    want = np.zeros(100)
    expected = Expected(want, 1.0, rms=0.2)
    one, all_ = want.copy(), want + 0.3
    one[7] = 0.9
    assert expected.closer(one) is expected
    assert round(expected.together(one), 9) == 0.45
    closer = expected.closer(all_)
    assert (closer.allowed, int((closer.ratios(all_) > 1).sum())) == (0.2, 100)
    assert expected.closer(want + 2) is expected, "beyond the bound of each number"


def test_the_message_says_which_limit_is_exceeded():
    """Only the ratio of the rms is beyond 1."""
    got = np.zeros(100) + 0.3
    got[7] = 0.9
    words = describe("erm.reshaded", got, Expected(np.zeros(100), 1.0, rms=0.2))
    assert words == (
        "erm.reshaded: rms / bound 1.56, though error / bound is at most 0.9; largest error at [7]: got 0.9, expected 0; "
        "100.0% of 100 errors are above 0.2, the bound of the rms"
    )
