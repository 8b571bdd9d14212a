# SPDX-License-Identifier: MIT
"""Right ports pass: a part of ``make alarms``, which runs the full tier on all of them."""

import pytest

from conformance.judging.judge import Tier
from tests.meta.run_false_alarms import judged


@pytest.mark.parametrize("name", ["orders", "flush", "fma", "half", "winograd_4"])
def test_no_false_alarm(name):
    alarms, worst, (cases, _, unjudged) = judged(name, Tier("some", 8, 2))
    assert not alarms
    assert 0 < max(worst.values()) <= 1
    assert cases > 250
    assert unjudged < cases / 50
