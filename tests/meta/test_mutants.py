# SPDX-License-Identifier: MIT
"""Every planted fault still applies to the reference, runs like a port, and changes the result."""

import sys
from functools import cache

import numpy as np
import pytest

import conformance.protocol.stages
from conformance.cases.large_inputs import large_inputs
from conformance.judging.judge import TIERS, Judge
from conformance.mistakes import MISTAKES, find, of_stage
from conformance.protocol.reference_copy import PlantError, load, put
from conformance.protocol.stages import STAGES, check_inputs, check_outputs, reference
from stss.port import ReferencePort
from stss_lab.stress.inputs import exact as as_float64
from stss_ref.sample import follow
from tests.meta.samples import departs, samples
from tests.tiers import every


def by_id(mutant):
    return mutant.id


@cache
def tried(stage, *, large):
    """Samples, or the large frames of the quick tier."""
    if not large:
        return samples(stage)
    judge = Judge(ReferencePort())
    cases_made = [make(np.random.default_rng(0)) for make in large_inputs(stage, TIERS["quick"].large)]
    return [judge.make_case(stage, *(case if STAGES[stage].weights else (case,))) for case in cases_made]


@cache
def truth(stage, *, large):
    """Of each what the reference computes, in float64 and in float32."""
    with np.errstate(all="ignore"):
        return [
            (reference(stage, as_float64(case.inputs), case.weights), reference(stage, case.inputs, case.weights))
            for case in tried(stage, large=large)
        ]


def is_found_out(port, stage, *, bits, large=False):
    """Whether a sample tells the port from the reference, by its bits or by more than any bound of a stage allows.

    Everything it gives must fit the table of stages: a fault is to be found by its numbers, not by a crash.
    """
    is_found = False
    for case, (exact, rounded) in zip(tried(stage, large=large), truth(stage, large=large), strict=True):
        got = port.run(stage, case.inputs, case.weights)
        check_outputs(stage, got, check_inputs(stage, case.inputs))
        is_found |= departs(got, rounded, None) if bits else departs(got, exact, "stage.cl")
        # Only where indices are computed can one sample crash and another not; the others take long.
        if is_found and case.weights is not None:
            break
    return is_found


@pytest.mark.parametrize("mutant", every(8, MISTAKES), ids=by_id)
def test_a_fault_is_one(mutant):
    """It applies, runs, and shows in every stage whose tests must catch it."""
    port = mutant.port()
    for stage in (mutant.stage, *mutant.also):
        assert is_found_out(port, stage, bits=mutant.bits, large=mutant.large), f"{stage}: no sample shows it; is it large?"


@pytest.mark.parametrize("mutant", [mutant for mutant in MISTAKES if mutant.bits], ids=by_id)
def test_a_fault_of_bits_is_within_the_bounds(mutant):
    """Otherwise its mark would excuse a suite that misses it."""
    assert not is_found_out(mutant.port(), mutant.stage, bits=False)


@pytest.mark.parametrize("stage", STAGES)
def test_an_unchanged_copy_is_the_reference(stage):
    """Bit for bit, so that a mutant differs only by its fault; and float32 alone is no fault."""
    copy = load("copy")
    assert copy.stages() == set(STAGES)
    assert not is_found_out(copy, stage, bits=True)
    assert not is_found_out(copy, stage, bits=False)


def test_they_are_found_by_stage_and_by_name():
    assert find("warp_x_sign") in of_stage("warp")
    assert find("warp_x_sign") not in of_stage("holes")
    assert find("warp_x_sign") in of_stage("holes", shared=True)


@pytest.mark.parametrize("name", ["conv.no_such_function", "cows.conv", "warp.pad_to_8"])
def test_a_plant_that_does_not_fit_is_an_error(name):
    with pytest.raises(PlantError, match=f"{name}: no such name"):
        load("wrong", put(name, abs))


def test_a_name_is_replaced_where_it_is_defined_or_imported():
    """In the whole copy if its module defines it; in that module alone if it imports it."""
    case = samples("frame")[0]
    whole, one = (load("still", put(f"{module}.follow", lambda motion: follow(motion * 0))) for module in ("sample", "warp"))
    for stage, there in (("warp", (whole, one)), ("motion_chain", (whole,))):
        wrong = [port for port in (whole, one) if is_found_out(port, stage, bits=False)]
        assert wrong == [*there]
    assert departs(one.run("frame", case.inputs, case.weights), reference("frame", case.inputs, case.weights), "stage.cl")


def test_nothing_is_left_of_a_copy():
    """The reference is what it was, module by module."""
    before = {name: module for name, module in sys.modules.items() if name.startswith(("stss_ref", "conformance.protocol"))}
    load("copy")
    assert {name: sys.modules.get(name) for name in before} == before
    assert conformance.protocol.stages is sys.modules["conformance.protocol.stages"]
