# SPDX-License-Identifier: MIT
"""Every planted fault is found out by the quick tier, with the seed that a user gets. ``make mutants`` prints which test did it."""

import pytest

from conformance.mistakes import MISTAKES, find
from stss.conform.failures import keep_failure, replay
from stss.conform.own_ports import ReferencePort
from tests.meta.run_mutants import failed


@pytest.mark.parametrize("name", [mutant.id for mutant in MISTAKES])
def test_found_out(name, tmp_path):
    """And from the folder that is kept the mutant fails again, while a mended port, the reference, passes."""
    (result,) = failed(name)
    kept = keep_failure(tmp_path, result.id, result.record.failure, "stss conform")
    assert replay(ReferencePort(), kept).failure is None
    assert replay(find(name).port(), kept).failure is not None
