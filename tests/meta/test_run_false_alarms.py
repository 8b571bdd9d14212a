# SPDX-License-Identifier: MIT
"""Right ports pass: a part of ``make alarms``, which runs the full tier on all of them."""

import pytest

from conformance.judging.judge import Tier
from conformance.protocol.stages import STAGES
from tests.meta.run_false_alarms import judged

JUDGED = {
    "orders": ["motion_chain", "warp", "holes", "occlusion_warp"],
    "flush": ["rrm", "history"],
    "fma": ["decoder", "frame"],
    "half": ["erm"],
    "winograd_4": ["encoder", "network"],
}
"""Each stage once, by a port whose arithmetic there is another one."""


@pytest.mark.parametrize("name", JUDGED)
def test_no_false_alarm(name):
    alarms, worst, (cases, _, unjudged) = judged(name, Tier("some", 6, 1, 0), JUDGED[name])
    assert not alarms
    assert 0 <= max(worst.values()) <= 1
    assert cases >= 10
    assert unjudged < cases / 10


def test_every_stage_is_judged():
    assert sorted(stage for stages in JUDGED.values() for stage in stages) == sorted(STAGES)
