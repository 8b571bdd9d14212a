# SPDX-License-Identifier: MIT
"""What is found in a display frame that arrives, against NumPy."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stss_cl.device.buffers import incoming
from stss_cl.skip.arrival import COMPARED, FINITE, Arrival

FLOATS = {"motion": 2, "gbuffer": 9, "nov": 1, "stencil": 1, "position": 3, "color": 3}
VALUES = (-0.0, 1e-45, np.float32(1) - np.float32(2**-24), np.nan, -np.inf)


@st.composite
def changed_frames(draw):
    """Size, which values change to what, whether there are colours, and whether the frames are compared."""
    size = draw(st.integers(1, 21)), draw(st.sampled_from((1, 3, 8, 17, 64, 67, 131, 1031)))
    places = st.tuples(st.sampled_from(tuple(FLOATS)), st.floats(0, 1, exclude_max=True), st.sampled_from(VALUES))
    return size, draw(st.lists(places, max_size=4)), draw(st.booleans()), draw(st.booleans())


@given(changed_frames())
def test_changes_and_what_is_not_finite_are_found(device, drawn):
    (height, width), places, colored, compares = drawn
    before = {name: np.zeros((height, width, n), np.float32) if name == "motion" else np.ones((height, width, n), np.float32)
              for name, n in FLOATS.items()}  # fmt: skip
    now = {name: array.copy() for name, array in before.items()}
    for name, where, value in places:
        now[name].flat[int(where * now[name].size)] = value
    shown = {name: incoming(device, array) for name, array in now.items()}
    earlier = {name: incoming(device, array) for name, array in before.items()}
    color, color_before = shown.pop("color"), earlier.pop("color")
    arrival = Arrival(device, height, width)
    bad, changed, recolored = arrival.look(
        shown, color if colored else None, earlier if compares else None, color_before if compares else None
    )
    bad = bad or arrival.not_finite()
    expected = [name for name in FINITE if not np.isfinite(now[name]).all() and (colored or name != "color")]
    assert bad == (expected[0] if expected else None)
    if expected or not compares:
        assert changed is None
        return
    moved = tiles_of((now["motion"] != 0).any(-1))
    for name in COMPARED:
        moved |= tiles_of((now[name].view(np.uint32) != before[name].view(np.uint32)).any(-1))
    assert np.array_equal(changed, moved)
    if colored:
        assert np.array_equal(recolored, tiles_of((now["color"].view(np.uint32) != before["color"].view(np.uint32)).any(-1)))


def tiles_of(pixels):
    """Where one of 4 x 4 pixels is marked."""
    height, width = (-(-n // 4) * 4 for n in pixels.shape)
    padded = np.pad(pixels, ((0, height - pixels.shape[0]), (0, width - pixels.shape[1])))
    return padded.reshape(height // 4, 4, width // 4, 4).any((1, 3))
