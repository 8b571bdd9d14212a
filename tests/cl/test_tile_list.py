# SPDX-License-Identifier: MIT
"""The tiles that marks reach, against NumPy."""

import numpy as np
import pyopencl as cl
from hypothesis import example, given
from hypothesis import strategies as st

from stss_cl.device.buffers import map_bytes
from stss_cl.device.grid import ceil_div
from stss_cl.device.parts import make_zeros
from stss_cl.network.tiles import Maps, TileList, Tiling, find_tiles

READS = [((4, 4), 1, 0), ((4, 4), 1, -1), ((4, 4), 0, -1), ((4, 4), 2, 1), ((2, 2), 1, 0), ((4, 32), 1, 0), ((8, 64), 1, -1)]
MARKED = st.tuples(st.integers(0, 2), st.integers(0, 35), st.sampled_from((0, 3, 4, 8, 31, 63, 64, 127, 255, 256, -1)))


@given(st.sampled_from(READS), st.integers(1, 3), st.booleans(), st.integers(1, 9), st.sampled_from((1, 2, 16, 63, 64, 65, 129)),
       st.lists(MARKED, max_size=5))  # fmt: skip
@example(READS[6], 1, False, 3, 65, [(0, 0, 63), (0, 11, 255)])  # the last that a tile reads; what two work-items read
def test_tiles_are_listed_that_marks_reach(device, window, count, images, fours_down, fours_across, marked):
    (height, width), (step, before, beyond) = (4 * fours_down, 4 * fours_across), window
    size = [ceil_div(length, s) for length, s in zip((height, width), step, strict=True)]
    tiling = Tiling(*size, step, before, beyond, count if images else 1)
    maps = np.zeros((count, height, width), np.uint8)
    for which, y, x in marked:
        maps[which % count, y % height, x % width] = 1
    arrays = [maps] if images else list(maps)
    buffers = [make_zeros(device, map_bytes(height, width, count)) for _ in arrays]
    for buffer, array in zip(buffers, arrays, strict=True):  # what lies behind a map is not 0
        cl.enqueue_copy(device.queue, buffer, np.concatenate([array.ravel(), np.ones(64, np.uint8)]))
    to = TileList(make_zeros(device, 4 * tiling.most), make_zeros(device, 4))
    find_tiles(device, tiling, Maps(tuple(buffers), height, width), to).enqueue(device.queue)
    count, tiles = np.empty(1, np.int32), np.empty(tiling.most, np.uint32)
    cl.enqueue_copy(device.queue, count, to.count)
    cl.enqueue_copy(device.queue, tiles, to.tiles)
    four = 1 if device.is_cpu else 4  # pixels that count as one
    expected = [
        (image * size[0] + y) << 16 | x
        for image, each in enumerate(maps if images else [maps.any(0)])
        for y, x in np.ndindex(*size)
        if each[max(step[0] * y - before, 0) : step[0] * (y + 1) + beyond + 1,
                max(step[1] * x - before, 0) // four * four : (step[1] * (x + 1) + beyond) // four * four + four].any()
    ]  # fmt: skip
    assert sorted(tiles[: count[0]]) == expected
