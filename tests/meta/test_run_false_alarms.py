# SPDX-License-Identifier: MIT
"""Right ports pass: a part of ``make alarms``, which runs the full tier on all of them."""

import json
import sys

import numpy as np
import pytest

from conformance.answers.windows import place_of, places
from conformance.cases import large_inputs
from conformance.cases.stage_inputs import make_weights
from conformance.judging.judge import TIERS, Judge, Tier
from conformance.protocol.stages import STAGES
from conformance.suite.run_suite import run_suite
from conformance.tolerance import ratio
from tests.meta.right_ports import port, port_in_windows
from tests.meta.run_false_alarms import judged, main, stands_for
from tests.tiers import thorough

JUDGED = {
    "orders": ["warp", "holes", "reshade", "accumulate"],
    "double": ["motion_chain"],
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
    for name, stages in JUDGED.items():
        others = [stage for stage in stages if stands_for(name, stage) != name]
        assert not others, f"{name} has no arithmetic of its own at {others}; expected it in tests/meta/right_ports.py"


def test_a_key_may_lose_what_is_no_normal_number():
    """Such a key in half has a few bits, or none: its direction decides whose light is read, so no port is asked for it."""
    inputs, _ = large_inputs.network_case("erm", (16, 16), np.random.default_rng(0))
    case = inputs, make_weights("small keys", 0)
    Judge(port("half_flush")).check(lambda judge, drawn: judge.agrees("erm", *drawn), case)


@pytest.mark.parametrize("case", large_inputs.large_inputs("motion_chain", 1))
def test_a_chain_may_be_stored_in_half(case):
    """Its motion of thousands of pixels is off by several, and then may read any motion there."""
    Judge(port("half_flush")).check(lambda judge, inputs: judge.agrees("motion_chain", inputs), case(np.random.default_rng(0)))


def test_a_port_is_judged_where_its_own_functions_are_called():
    """Not where it differs from ``as_is`` in bits: sums decide masks, which hardly ever differ."""
    assert stands_for("in_order", "warp") == "as_is"
    assert stands_for("in_order", "sequence") == "in_order"
    assert stands_for("orders", "holes") == "orders"
    assert stands_for("flush", "rrm") == "flush"


def test_a_stopped_run_goes_on(monkeypatch, tmp_path, capsys):
    file = tmp_path / "found.json"
    file.write_text(json.dumps({"as_is rrm": [["an alarm"], {"rrm": 0.0}, [1, 0, 0]]}))
    monkeypatch.setattr(sys, "argv", ["run_false_alarms", "as_is", "rrm", "--found", str(file)])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 1
    assert "cases" not in capsys.readouterr().out  # nothing was judged again


@pytest.fixture
def small_frames(monkeypatch):
    """A user's frame has 88 x 264 pixels."""
    monkeypatch.setattr("conformance.answers.windows.SIDE", 16)
    monkeypatch.setattr("conformance.answers.windows.TILE", 64)
    monkeypatch.setattr("conformance.cases.large_inputs.USER_SIZES", dict.fromkeys(("quick", "full"), (88, 264)))


@pytest.mark.usefixtures("small_frames")
@pytest.mark.parametrize("stage", ["history", "encoder", "erm", "decoder", "network", "frame"])
def test_a_port_in_windows_is_the_port(stage):
    """There it has the whole's numbers, by sums in its own order; elsewhere it computed nothing."""
    (make,) = large_inputs.user_inputs(stage, 99)
    inputs, weights = make(np.random.default_rng(0))
    case = Judge(port("as_is")).make_case(stage, inputs, weights)
    whole, other, part = (
        make(name).run(stage, case.inputs, case.weights)
        for make, name in ((port, "in_order"), (port, "as_is"), (port_in_windows, "in_order"))
    )
    for name, spec in STAGES[stage].outputs.items():
        judged = [place_of(spec, window) for window in places(88, 264)]
        assert all(ratio("network.float32", part[name][place], whole[name][place]) < 1 for place in judged)
        apart, changed = (sum(np.sum(x[name][place] != whole[name][place]) for place in judged) for x in (part, other))
        assert apart < changed / 10
        assert np.count_nonzero(part[name]) <= sum(part[name][place].size for place in judged)


@pytest.mark.usefixtures("small_frames")
@pytest.mark.parametrize("name", ["orders", "half"])
def test_a_port_in_windows_enlarges_as_the_whole_does(name):
    """Also one with an ``upsample_corners`` of its own, which does not know of windows."""
    (result,) = run_suite(Judge(port_in_windows(name), TIERS["full"]), ["decoder"], only="users_size")
    assert (result.outcome, result.record.largest) == ("passed", (88, 264))
