"""The frames from which a display frame is made."""

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


@pytest.mark.parametrize(
    ("number", "rendered", "reach", "planned"),
    [
        (1, {2, 4}, 5, None),  # nothing to extrapolate from
        (8, {2, 4}, 5, None),
        (8, EVEN, 3, (FrameKind.SF, (0, 2, 2))),  # a broken chain of motion ends the history
        (9, EVEN, 0, None),
        (8, EVEN - {6}, 5, (FrameKind.SF, (0, 0, 0))),  # and so does a frame missing in the middle
    ],
)
def test_where_the_history_ends(number, rendered, reach, planned):
    assert schedule(number, rendered, reach=reach) == planned


@given(number=st.integers(0, 50), rendered=st.frozensets(st.integers(0, 60)), reach=st.integers(0, 5))
def test_only_rendered_frames_and_none_of_the_future(number, rendered, reach):
    answer = schedule(number, rendered, reach=reach)
    if answer is None:
        assert number not in rendered
        return
    assert (answer.kind is FrameKind.SF) == (number in rendered)
    for i, step in enumerate(answer.steps):
        assert 0 <= step <= reach
        assert number - step in rendered
        assert step == STEPS[answer.kind][i] or step == answer.steps[i - 1]
