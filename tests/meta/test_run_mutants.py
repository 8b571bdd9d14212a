# SPDX-License-Identifier: MIT
"""Every planted fault is found out by the quick tier, with the seed that a user gets. ``make mutants`` prints which test did it."""

import pytest

from conformance.mistakes import MISTAKES, find
from conformance.report.failures import keep_failure, replay
from stss.port import ReferencePort
from tests.meta.run_mutants import failed

NAMES = [mutant.id for mutant in MISTAKES]
REPLAYED = set(NAMES[::8])
"""Some of each stage: a replay computes the right answers again, and those are most of what a test takes."""


@pytest.mark.parametrize("name", NAMES)
def test_found_out(name, tmp_path):
    """And from the folder that is kept the mutant fails again, while a mended port, the reference, passes."""
    (result,) = failed(name)
    if name not in REPLAYED:
        return
    kept = keep_failure(tmp_path, result.id, result.record.failure, "stss conform")
    assert replay(ReferencePort(), kept).failure is None
    assert replay(find(name).port(), kept).failure is not None


def test_some_of_each_stage_are_replayed():
    assert {mutant.stage for mutant in MISTAKES} == {find(name).stage for name in REPLAYED}
