"""Which frames a display frame is made of."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stss_ref.schedule import STEPS, FrameKind, schedule

EVEN = frozenset(range(0, 100, 2))


@pytest.mark.parametrize(
    ("number", "kind", "steps"),
    [
        (0, "SF", (0, 0, 0)),
        (1, "EF", (1, 1, 1)),
        (2, "SF", (0, 2, 2)),
        (3, "EF", (1, 3, 3)),
        (4, "SF", (0, 2, 4)),
        (5, "EF", (1, 3, 5)),
        (98, "SF", (0, 2, 4)),
        (99, "EF", (1, 3, 5)),
    ],
)
def test_the_start_and_the_steady_state(number, kind, steps):
    assert schedule(number, EVEN) == (FrameKind(kind), steps)


def test_nothing_to_extrapolate_from():
    assert schedule(1, {2, 4}) is None
    assert schedule(8, {2, 4}) is None


def test_a_broken_chain_of_motion_ends_the_history():
    assert schedule(8, EVEN, reach=3) == (FrameKind.SF, (0, 2, 2))
    assert schedule(9, EVEN, reach=0) is None


def test_a_frame_missing_in_the_middle_ends_the_history():
    assert schedule(8, EVEN - {6}) == (FrameKind.SF, (0, 0, 0))


@given(number=st.integers(0, 50), rendered=st.frozensets(st.integers(0, 60)), reach=st.integers(0, 5))
def test_only_rendered_frames_and_none_of_the_future(number, rendered, reach):
    planned = schedule(number, rendered, reach=reach)
    if planned is None:
        assert number not in rendered
        return
    assert (planned.kind is FrameKind.SF) == (number in rendered)
    for i, step in enumerate(planned.steps):
        assert 0 <= step <= reach
        assert number - step in rendered
        assert step == STEPS[planned.kind][i] or step == planned.steps[i - 1]
