# SPDX-License-Identifier: MIT
"""The findings about a newly uploaded display frame, against NumPy."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stss_cl.device.buffers import incoming
from stss_cl.skip.arrival import COMPARED, FINITE, Arrival

FLOATS = {"motion": 2, "gbuffer": 9, "nov": 1, "stencil": 1, "position": 3, "color": 3}
VALUES = (-0.0, 1e-45, np.float32(1) - np.float32(2**-24), np.nan, -np.inf)
PLACES = st.tuples(st.sampled_from(tuple(FLOATS)), st.floats(0, 1, exclude_max=True), st.sampled_from(VALUES))


@given(
    st.integers(1, 21),
    st.sampled_from((1, 3, 8, 17, 64, 67, 131, 1031)),
    st.lists(PLACES, max_size=4),
    st.booleans(),
    st.booleans(),
)
def test_changes_and_what_is_not_finite_are_found(device, height, width, places, colored, compares):
    before = {name: np.full((height, width, n), name != "motion", np.float32) for name, n in FLOATS.items()}
    now = {name: array.copy() for name, array in before.items()}
    for name, where, value in places:
        now[name].flat[int(where * now[name].size)] = value
    now_planes, earlier = ({name: incoming(device, array) for name, array in each.items()} for each in (now, before))
    color, color_before = now_planes.pop("color"), earlier.pop("color")
    arrival = Arrival(device, height, width)
    compared = (earlier, color_before) if compares else (None, None)
    bad, changed, recolored = arrival.look(now_planes, color if colored else None, *compared)
    expected = [name for name in FINITE if not np.isfinite(now[name]).all() and (colored or name != "color")]
    assert (bad or arrival.not_finite()) == (expected[0] if expected else None)
    differ = {name: (now[name].view(np.uint32) != before[name].view(np.uint32)).any(-1) for name in (*COMPARED, "color")}
    moved = np.logical_or.reduce([(now["motion"] != 0).any(-1), *(differ[name] for name in COMPARED)])
    for marks, pixels, pixels_known in ((changed, moved, True), (recolored, differ["color"], colored)):
        if expected or not compares or not pixels_known:
            assert marks is None
        else:
            padded = np.pad(pixels, ((0, -height % 4), (0, -width % 4)))
            assert np.array_equal(marks, padded.reshape(len(padded) // 4, 4, -1, 4).any((1, 3)))
