# SPDX-License-Identifier: MIT
"""How deep the network is computed where everything changes."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stss.frames.supersample import plan
from stss_cl.device.buffers import Outgoing, incoming
from stss_cl.network.layers import Layers
from stss_cl.network.network import PRECISIONS
from stss_cl.skip.error_control import RULES, LevelControl, Shot
from stss_cl.skip.frame_cache import distance
from stss_cl.skip.partial_network import WHOLE, Level, PartialNetwork
from stss_cl.skip.stream import Stream
from stss_ref.weights import random as random_weights
from tests.cl.test_stream import UNREAD, WEIGHTS, assert_same, first_frame, next_frame

SIZE = (24, 40)


def inputs(seed):
    rng = np.random.default_rng(seed)
    shapes = ((*SIZE, 6), (*SIZE, 9), SIZE, (3, *SIZE, 4))
    return [rng.random(shape, np.float32) for shape in shapes]


@pytest.mark.parametrize("precision", PRECISIONS)
def test_what_stayed_is_made_up_for(device, precision):
    """At every level: less is launched, the image differs, and ``complete`` gives the bits of the whole network."""
    layers = Layers(device, WEIGHTS, *SIZE, precision, keep=True)
    network = PartialNetwork(layers)

    def run(seed, level=None):
        arrays = inputs(seed)  # read in place on a processor: they must stay
        layers.pack(*(incoming(device, array) for array in arrays))
        image = Outgoing(device, (2 * SIZE[0], 2 * SIZE[1], 3), on_device=False)
        network.run(image.data, WHOLE if level is None else Level(level.stays, flat=False, history=level.history))
        stale = image.finish().copy()
        if level is None:
            return stale, stale
        network.complete(image.data, level)
        return stale, image.finish().copy()

    whole = run(1)[1]
    run(2)
    assert network.levels[1] == (frozenset(), True, True)
    for before, level in pairwise(network.levels[1:]):  # test_flat_tiles.py is about flat tiles
        assert before.stays < level.stays
        run(2)
        stale, mended = run(1, level)
        assert not np.array_equal(stale, whole)
        np.testing.assert_array_equal(mended, whole)
        np.testing.assert_array_equal(run(1, level)[0], whole)  # nothing is stale where the inputs are those of the last time


def test_weights_that_do_not_read_the_history(device):
    layers = Layers(device, UNREAD, *SIZE, "float32", keep=True)
    network = PartialNetwork(layers)
    assert [level.history for level in network.levels] == 4 * [False]
    assert {layers.launches[i].name for i in network.levels[0].stays} == {"lowlevelGated"}


def test_without_a_residual_or_without_keeping_nothing_may_stay(device):
    assert PartialNetwork(Layers(device, WEIGHTS, *SIZE, "float32")).levels == (WHOLE,)
    assert PartialNetwork(Layers(device, WEIGHTS, *SIZE, "float32", residual=False, keep=True)).levels == (WHOLE,)


@given(departures=st.lists(st.floats(0, 3), min_size=4, max_size=4).map(sorted))
def test_the_level_goes_as_deep_as_the_departure_allows(departures):
    """A level that departs by the same amount whenever it is checked: the deepest that is within the aim is found and kept."""
    control, levels = LevelControl(3, 1.0), []
    departures[0] = 0.0
    for _ in range(200):
        level, due = control.next()
        levels.append(level if not due else None)
        if due:
            control.judge(departures[level])
    shown = [level for level in levels if level is not None]
    aims = 0.0, RULES.aim, RULES.old_aim, RULES.old_aim
    best = next((level - 1 for level in range(1, 4) if departures[level] > aims[level]), 3)
    assert all(departures[level] <= aims[level] for level in shown)
    assert max(shown) == best
    assert control.level == best


def test_checks_become_rare_and_common_again():
    control, due = LevelControl(1, 1.0), []
    for _ in range(200):
        due.append(control.next()[1])
        if due[-1]:
            control.judge(0.1)
    apart = np.diff(np.flatnonzero(due))
    assert list(apart[:3]) == [RULES.first_check, RULES.first_check * RULES.growth, RULES.first_check * RULES.growth**2]
    assert apart[-1] == RULES.rarest_trial
    while not control.next()[1]:
        pass
    control.judge(2.0)
    assert control.level == 0
    assert control.next() == (0, False)
    assert any(control.next()[1] for _ in range(RULES.level_rest + RULES.first_check))


def test_what_stays_is_tried_when_a_shot_has_lasted():
    control, before = LevelControl(2, 1.0), 0
    while control.level < 2:
        before += 1
        if control.next()[1]:
            control.judge(0.0)
    assert before == 1 + RULES.first_check * (1 + RULES.growth + RULES.growth**2 + RULES.growth**3)  # the last of these is LATER


@pytest.mark.parametrize(("level", "aim"), [(1, RULES.aim), (2, RULES.old_aim)])
def test_what_departs_too_much_is_checked_more_often_and_then_left(level, aim):
    def check(departure):
        apart = 1
        while not control.next()[1]:
            apart += 1
        control.judge(departure)
        return apart

    control = LevelControl(level, 1.0)
    while control.level < level:
        check(0.0)
    while check(0.0) < 16:
        pass
    assert control.level == level
    assert [check(1.9 * aim) for _ in range(4)] == [32, 16, 8, 4]
    check(2.1 * aim)
    assert control.level == level - 1


def test_a_level_that_was_too_deep_once_is_tried_again():
    control, too_deep = LevelControl(2, 1.0), True
    reached = []
    for step in range(900):
        too_deep = step < 300
        level, due = control.next()
        reached.append(control.level)
        if due:
            control.judge(0.0 if level < 2 else 3.0 * too_deep)
    assert max(reached[:300]) == 1
    assert reached[-1] == 2


def test_another_shot_is_told_from_a_moving_camera():
    rng = np.random.default_rng(0)
    picture = np.cumsum(rng.normal(0, 0.01, (90, 160, 3)), axis=1).astype(np.float32) + 0.5
    shot = Shot()
    assert shot.cut(picture)
    assert not shot.cut(np.roll(picture, 4, axis=1))
    checker = ((np.indices((90, 160)) // 7).sum(axis=0) % 2)[..., None].repeat(3, -1).astype(np.float32)
    shot.cut(checker)
    assert not shot.cut(np.roll(checker, 7, axis=1))
    shot.cut(picture)
    assert shot.cut(1 - picture + 0.3)
    assert shot.cut(picture[:60])


@pytest.fixture
def early(monkeypatch):
    """What may stay is tried in a shot's first frames, for shots that are short."""
    monkeypatch.setattr("stss_cl.skip.error_control.RULES", replace(RULES, later=RULES.first_check))


@pytest.mark.usefixtures("early")
@pytest.mark.parametrize("max_error", [0.9, 1e-9])
def test_a_moving_camera(device, max_error):
    """With a wide bound the deep layers stay most of the time; with a narrow one never: noise has no flat tiles."""
    rng, weights = np.random.default_rng(4), {name: w * np.float32(0.5) for name, w in random_weights(3).items()}
    made = first_frame(rng, SIZE, rendered=True)
    frames, color = [made], made.color
    for i in range(1, 70):
        made, color = next_frame(rng, made, color, "everything", rendered=i % 2 == 0)
        color = frames[0].color + np.float32(0.01) * color  # no cut
        frames.append(type(made)(made.number, color if i % 2 == 0 else None, *list(vars(made).values())[2:]))
    plain, loose = Stream(weights, device, skip="off"), Stream(weights, device, skip="bounded", max_error=max_error)
    partly = 0
    for i in range(70):
        window = frames[max(0, i - 5) : i + 1]
        steps, resting = plan(window).steps, loose._control.frames_unlooked > 1
        got, want = loose(window, steps), plain(window, steps)
        partly += loose.report.network == "partly"
        if loose.report.network == "whole" and resting:  # else tolerances kept some of the inputs
            assert_same(got, want)
        if max_error > 0.1:  # how well a narrow one is held is what tests/meta/bound_violations.py measures
            assert np.abs(got[0] - want[0]).max() <= max_error
        else:
            assert_same(got, want)
    assert partly > 20


@pytest.mark.usefixtures("early")
@pytest.mark.parametrize("looking", [False, True], ids=["resting", "looking"])
@pytest.mark.parametrize("weights", [WEIGHTS, UNREAD], ids=["read", "unread"])
def test_what_was_left_out_does_not_outlive_the_motion(device, weights, looking):
    """While nobody looks for changes the older frames are not even warped; at rest, and when somebody looks again, all is made up for."""
    rng = np.random.default_rng(8)
    made = first_frame(rng, SIZE, rendered=True)
    frames, color = [made], made.color
    for i in range(1, 100):
        made, color = next_frame(rng, made, color, "everything" if i < 40 else "nothing", rendered=i % 2 == 0)
        color = frames[0].color + np.float32(0.01) * color if i < 40 else frames[38].color
        frames.append(type(made)(made.number, color if i % 2 == 0 else None, *list(vars(made).values())[2:]))
    plain, loose = Stream(weights, device, skip="off"), Stream(weights, device, skip="bounded", max_error=0.99)
    seen = []
    for i in range(100):
        window = frames[max(0, i - 5) : i + 1]
        loose._control.frames_unlooked *= not looking
        got, want = loose(window, plan(window).steps), plain(window, plan(window).steps)
        seen.append((loose.report.network, loose._control.frames_unlooked))
        if i >= 50 and not any(rests for _, rests in seen[-3:]):  # since then one frame of this kind was looked at
            assert_same(got, want)
    assert "partly" in [network for network, _ in seen[30:]]
    assert seen[-1] == ("none", 0)


@pytest.mark.usefixtures("early")
def test_old_features_do_not_outlive_the_motion(device):
    """When the camera comes to rest after frames that left deep features as they were, the next one is computed whole."""
    rng, made = np.random.default_rng(6), None
    made = first_frame(rng, SIZE, rendered=True)
    frames, color = [made], made.color
    for i in range(1, 60):
        made, color = next_frame(rng, made, color, "everything" if i < 40 else "nothing", rendered=i % 2 == 0)
        color = frames[0].color + np.float32(0.01) * color if i < 40 else frames[38].color.copy()
        if i > 40:
            color[i % 8, 3:5] += np.float32(0.5)
        frames.append(type(made)(made.number, color if i % 2 == 0 else None, *list(vars(made).values())[2:]))
    loose, seen = Stream(WEIGHTS, device, skip="bounded", max_error=0.99), []
    for i in range(60):
        loose._control.frames_unlooked = 0  # to look at every frame
        loose(frames[max(0, i - 5) : i + 1], plan(frames[max(0, i - 5) : i + 1]).steps)
        seen.append((loose.report.network, loose.report.changed))
    assert "partly" in [network for network, _ in seen[:40]]
    for kind in (0, 1):
        rest = [network for network, changed in seen[kind::2] if changed <= RULES.most_changed_bounded]
        before = [network for network, changed in seen[kind::2] if changed > RULES.most_changed_bounded]
        assert rest[0] == ("whole" if before[-1] == "partly" else "changed")
        assert set(rest[1:]) <= {"changed", "none"}


@pytest.mark.parametrize("row", [0, 31, 32, 69])
def test_the_distance_of_two_images_counts_every_row(row):
    a = np.zeros((70, 4, 3), np.float32)
    b = a.copy()
    b[row, 3, 2] = -0.5
    assert distance(a, b) == distance(b, a) == 0.5
