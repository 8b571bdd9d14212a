"""Sums that round to one side, or lose more than rounding does, though every number is within its bound."""

from functools import partial

import numpy as np
import pytest

from conformance.answers.port_arithmetic import Arithmetic
from conformance.cases.exact_weights import exact_inputs, rounded_sums
from conformance.cases.stage_inputs import multiples
from conformance.judging.findings import DepartureError
from conformance.judging.judge import Judge, Tier
from conformance.judging.search import DrawnCases
from conformance.protocol.reference_copy import load, put
from conformance.suite.properties import find_property
from stss_ref.conv import conv
from tests.meta import right_ports as others

pytestmark = pytest.mark.filterwarnings("ignore::hypothesis.errors.HypothesisWarning")
FEW = Tier("few", 1, 2)


def one_way(direction, factors, weights, bias):
    """Each sum after the other, rounded to float32 towards 0 or downwards."""
    sums = np.broadcast_to(bias, (factors.shape[1], len(bias))).astype(np.float32)
    for x, w in zip(factors.astype(np.float64), weights.astype(np.float64), strict=True):
        exact = x[:, None] * w + sums
        sums = exact.astype(np.float32)
        over = np.abs(sums) > np.abs(exact) if direction == "zero" else sums > exact
        sums = np.where(over, np.nextafter(sums, np.float32(0 if direction == "zero" else -np.inf)), sums)
    return sums


def add_in_half(factors, weights, bias):
    """The last addition is done in half: one rounding that no float32 port has."""
    return (factors.T @ weights + bias).astype(np.float16).astype(np.float32)


def port(add):
    return load("planted", put("conv.conv", partial(others.convolved, add)))


def judged(port, stage, name, strategy):
    judge = Judge(port, FEW, shrink=False)
    DrawnCases(strategy, slow=True).check(judge, find_property(f"{stage}.{name}"))
    return judge.record.worst


@pytest.mark.parametrize("direction", ["zero", "down"])
@pytest.mark.parametrize("stage", ["encoder", "decoder"])
def test_a_sum_that_rounds_to_one_side_is_found(stage, direction):
    with pytest.raises(DepartureError, match=f"{stage}.rounding: error / bound"):
        judged(port(partial(one_way, direction)), stage, "sums_round_either_way", rounded_sums(stage))


def cut_off(x):
    """Stored in half as some devices convert: what half does not hold is lost."""
    stored = x.astype(np.float16)
    over = np.abs(stored.astype(x.dtype)) > np.abs(x)
    return np.where(over, np.nextafter(stored, np.float16(0)), stored).astype(x.dtype)


@pytest.mark.parametrize("stage", ["history", "encoder", "erm", "decoder"])
@pytest.mark.parametrize("stored", [others.to_half, cut_off])
def test_half_that_is_cut_off_is_found(stage, stored):
    planted = put("conv.conv", lambda *arrays, **more: stored(conv(*arrays, **more)))
    half = load("planted", planted, entry=others.to_half, dtype="float16")
    if stored is others.to_half:
        assert max(judged(half, stage, "sums_round_either_way", rounded_sums(stage)).values()) < 1
    else:
        with pytest.raises(DepartureError, match=f"{stage}.rounding: error / bound"):
            judged(half, stage, "sums_round_either_way", rounded_sums(stage))


@pytest.mark.parametrize("name", ["orders", "winograd_4", "half"])
def test_what_the_erm_does_behind_its_sums_is_no_mistake(name):
    assert max(judged(others.port(name), "erm", "sums_round_either_way", rounded_sums("erm")).values()) < 1


@pytest.mark.parametrize("stage", ["encoder", "decoder"])
def test_one_rounding_is_one_too_many_where_none_is_needed(stage):
    def off_by_a_bit(factors, weights, bias):
        return np.nextafter(factors.T @ weights + bias, np.float32(9))

    with pytest.raises(DepartureError):
        judged(port(off_by_a_bit), stage, "what_needs_no_rounding_is_exact", exact_inputs(stage, multiples()))
    with pytest.raises(DepartureError):
        judged(port(add_in_half), stage, "sums_round_either_way", rounded_sums(stage))


@pytest.mark.parametrize("stage", ["history", "encoder", "decoder"])
def test_a_port_in_bfloat16_rounds_what_half_holds(stage):
    stored = Arithmetic("bfloat16").rounded
    port = load(
        "planted", put("conv.conv", lambda *arrays, **more: stored(conv(*arrays, **more))), entry=stored, dtype="bfloat16"
    )
    judged(port, stage, "what_needs_no_rounding_is_exact", exact_inputs(stage, multiples()))
    assert max(judged(port, stage, "sums_round_either_way", rounded_sums(stage)).values()) < 1


@pytest.mark.parametrize("name", ["pairwise", "winograd_4_near"])
def test_right_ports_pass(name):
    """Those that ``test_run_false_alarms`` leaves out."""
    for stage in ("encoder", "decoder"):
        judged(others.port(name), stage, "what_needs_no_rounding_is_exact", exact_inputs(stage, multiples()))
        assert max(judged(others.port(name), stage, "sums_round_either_way", rounded_sums(stage)).values()) < 1
