# SPDX-License-Identifier: MIT
"""Every planted fault is found out by the quick tier, with the seed that a user gets. ``make mutants`` prints which test did it."""

import pytest

from tests.meta.mutants import MUTANTS
from tests.meta.run_mutants import killers


@pytest.mark.parametrize("name", [mutant.id for mutant in MUTANTS])
def test_found_out(name):
    by, _ = killers(name)
    assert by
