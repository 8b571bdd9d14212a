# SPDX-License-Identifier: MIT
"""What is left out where everything changes, and how the largest error is held."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conformance.scenes import SCENES
from stss.frames.supersample import plan
from stss.sequence.scenes import display_frames
from stss_cl.network.layers import Layers
from stss_cl.skip.error_control import RULES, FlatControl, Shot
from stss_cl.skip.partial_network import PartialNetwork
from stss_cl.skip.stream import Stream
from tests.cl.test_stream import UNREAD, WEIGHTS, assert_same

SIZE = (72, 128)
MOVING = 28
MILD = {name: tensor * np.float32(0.3) for name, tensor in WEIGHTS.items()}
MILD_UNREAD = {name: tensor * np.float32(0.3) for name, tensor in UNREAD.items()}


@pytest.fixture(scope="module")
def film():
    """A camera that moves under a plain sky, and then stands still."""
    frames = list(display_frames(SCENES["sky"], SIZE, MOVING))
    for i in range(MOVING, MOVING + 16):
        last, colored = frames[MOVING - 1], frames[MOVING - 2].color
        frames.append(replace(last, number=i, color=colored if i % 2 == 0 else None, motion=np.zeros_like(last.motion)))
    return frames


def shown(stream, frames):
    """For each frame the network that was run, its departure and what came out."""
    for i in range(len(frames)):
        window = frames[max(0, i - 5) : i + 1]
        image = stream(window, plan(window).steps)
        yield stream.report.network, stream.report.departure, image


def test_weights_that_do_not_read_the_history(device):
    """What they make of it is computed once."""
    read, unread = (PartialNetwork(Layers(device, weights, 24, 40, "float32", keep=True)) for weights in (WEIGHTS, UNREAD))
    assert not read._constant
    assert {unread.layers.launches[i].name for i in unread._constant} == {"lowlevelGated"}


@given(departure=st.floats(0, 3), shots=st.lists(st.booleans(), min_size=200, max_size=200))
def test_flat_tiles_are_left_out_where_their_departure_allows(departure, shots):
    """Frames that would depart by the same amount whenever one is checked; each shot begins with a check."""
    control = FlatControl(1.0)
    for first in shots:
        left_out, check = control.next(cut=first)
        assert not (left_out and check)
        assert check or not first
        assert not left_out or departure <= RULES.aim
        if check:
            control.judge(departure)
    assert control.allowed == (departure <= RULES.aim)


def checks(control, departure, count):
    """Which of ``count`` frames are checked."""
    for i in range(count):
        _, check = control.next(cut=False)
        if check:
            control.judge(departure)
            yield i


def test_checks_become_rare_and_common_again():
    control = FlatControl(1.0)
    apart = np.diff(list(checks(control, 0.1, 200)))
    assert list(apart[:3]) == [RULES.first_check, RULES.first_check * RULES.growth, RULES.first_check * RULES.growth**2]
    assert apart[-1] == RULES.rarest_check
    assert list(np.diff(list(checks(control, 2.0, 200))))[-2:] == [RULES.retry] * 2
    assert not control.allowed
    again = np.diff(list(checks(control, 0.1, 200)))
    assert control.allowed
    assert again[0] == RULES.first_check


def test_another_shot_is_told_from_a_moving_camera():
    rng = np.random.default_rng(0)
    picture = np.cumsum(rng.normal(0, 0.01, (90, 160, 3)), axis=1).astype(np.float32) + 0.5
    shot = Shot()
    assert not shot.cut(picture)
    assert not shot.cut(np.roll(picture, 4, axis=1))
    checker = ((np.indices((90, 160)) // 7).sum(axis=0) % 2)[..., None].repeat(3, -1).astype(np.float32)
    shot.cut(checker)
    assert not shot.cut(np.roll(checker, 7, axis=1))
    shot.cut(picture)
    assert shot.cut(1 - picture + 0.3)
    assert shot.cut(picture[:60])


@pytest.mark.parametrize("weights", [MILD, MILD_UNREAD], ids=["read", "unread"])
def test_a_moving_camera(device, film, weights, monkeypatch):
    """Most frames are computed without their flat tiles; none departs too far, and those that are checked have the bits of ``off``."""
    monkeypatch.setattr("stss_cl.skip.error_control.RULES", replace(RULES, rest=4))
    plain, loose = Stream(weights, device, skip="off"), Stream(weights, device, skip="bounded", max_error=0.9)
    seen = []
    for (network, departure, got), (_, _, want) in zip(shown(loose, film), shown(plain, film), strict=True):
        seen.append(network)
        if network != "partly":
            assert departure is None or network == "whole"
            assert_same(got, want)
        else:
            assert 0 < np.abs(got[0] - want[0]).max() <= 0.9
    assert seen[:MOVING].count("partly") > MOVING // 2
    assert "partly" not in seen[MOVING + 4 + 2 :]  # what was left out does not outlive the motion
    assert seen[-1] == "none"


def test_the_departure_of_a_frame_that_is_checked(device, film):
    """It is what the same frame departs by without its flat tiles; a bound that it exceeds leaves nothing out."""
    plain, loose, strict = (
        Stream(MILD, device, skip=skip, max_error=error) for skip, error in (("off", 0), ("bounded", 0.9), ("bounded", 1e-6))
    )
    frames, departures = film[:12], {}
    for i, (network, departure, _) in enumerate(shown(loose, frames)):
        assert departure is None or network == "whole"
        departures[i] = departure
    flat = [departure for departure in departures.values() if departure is not None]
    assert 0 < max(flat) <= 0.45
    for (network, _, got), (_, _, want) in zip(shown(strict, frames), shown(plain, frames), strict=True):
        assert network == "whole"
        assert_same(got, want)
