# SPDX-License-Identifier: MIT
"""Right ports pass: a part of ``make alarms``, which runs the full tier on all of them."""

import numpy as np
import pytest

from conformance.cases.large_inputs import network_case
from conformance.cases.stage_inputs import make_weights
from conformance.judging.judge import Judge, Tier
from conformance.protocol.stages import STAGES
from tests.meta.right_ports import port
from tests.meta.run_false_alarms import judged
from tests.tiers import thorough

JUDGED = {
    "orders": ["motion_chain", "warp", "holes", "reshade", "accumulate"],
    "flush": ["rrm", "history"],
    "fma": ["decoder", "frame"],
    "half_flush": ["occlusion_warp", "erm"],
    "winograd_4": ["encoder", "network"],
}
"""Each stage once, by a port whose arithmetic there is another one."""


@pytest.mark.parametrize("name", [name if name == "orders" else thorough(name) for name in JUDGED])
def test_no_false_alarm(name):
    alarms, worst, (cases, _, unjudged) = judged(name, Tier("some", 6, 1, 0), JUDGED[name])
    assert not alarms
    assert 0 <= max(worst.values()) <= 1
    assert cases >= 10
    assert unjudged < cases / 10


def test_every_stage_is_judged():
    assert sorted(stage for stages in JUDGED.values() for stage in stages) == sorted(STAGES)


def test_a_key_may_lose_what_is_no_normal_number():
    """Such a key in half has a few bits, or none: its direction decides whose light is read, so no port is asked for it."""
    inputs, _ = network_case("erm", (16, 16), np.random.default_rng(0))
    case = inputs, make_weights("small keys", 0)
    Judge(port("half_flush")).check(lambda judge, drawn: judge.agrees("erm", *drawn), case)
