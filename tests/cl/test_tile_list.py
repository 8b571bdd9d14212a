# SPDX-License-Identifier: MIT
"""The tiles that marks reach, against NumPy."""

import numpy as np
import pyopencl as cl
from hypothesis import given
from hypothesis import strategies as st

from stss_cl.device.buffers import map_bytes
from stss_cl.device.grid import ceil_div
from stss_cl.device.parts import zeroed
from stss_cl.network.tiles import Maps, TileList, Tiling, find_tiles, of_convolution

TILINGS = {
    "stride 1": lambda h, w, images: of_convolution(h, w, 1, 3),
    "stride 2": lambda h, w, images: of_convolution(ceil_div(h, 2), ceil_div(w, 2), 2, 3, 2),
    "one pixel": lambda h, w, images: of_convolution(h, w, 1, 1),
    "attention": lambda h, w, images: of_convolution(h, w, 1, 5),
    "upsampling": lambda h, w, images: Tiling(ceil_div(2 * h, 4), ceil_div(2 * w, 4), (2, 2), 1, 0),
    "wide": lambda h, w, images: Tiling(ceil_div(h, 4), ceil_div(w, 32), (4, 32), 1, 0, images),
    "wide, stride 2": lambda h, w, images: Tiling(ceil_div(h, 8), ceil_div(w, 64), (8, 64), 1, -1),
}


@given(
    st.sampled_from(sorted(TILINGS)), st.integers(1, 3), st.integers(1, 9), st.sampled_from((1, 2, 16, 63, 64, 65, 129)),
    st.lists(st.tuples(st.integers(0, 2), st.integers(0, 35), st.sampled_from((0, 3, 4, 8, 31, 63, 64, 127, 255, 256, -1))), max_size=5),
)  # fmt: skip
def test_tiles_are_listed_that_marks_reach(device, name, count, fours_down, fours_across, marked):
    height, width = 4 * fours_down, 4 * fours_across
    tiling = TILINGS[name](height, width, count)
    maps = np.zeros((count, height, width), np.uint8)
    for which, y, x in marked:
        maps[which % count, y % height, x % width] = 1
    if tiling.images > 1:  # one buffer that holds the maps of all images
        arrays, expected = [maps], [reached(each, tiling, device) for each in maps]
    else:
        arrays, expected = list(maps), [reached(maps.any(0), tiling, device)]
    buffers = [zeroed(device, map_bytes(height, width, len(array) if array.ndim == 3 else 1) + 64) for array in arrays]
    for buffer, array in zip(buffers, arrays, strict=True):  # what lies behind a map is not 0
        cl.enqueue_copy(device.queue, buffer, np.concatenate([array.ravel(), np.ones(64, np.uint8)]))
    to = TileList(zeroed(device, 4 * tiling.most), zeroed(device, 4))
    find_tiles(device, tiling, Maps(tuple(buffers), height, width), to).enqueue(device.queue)
    found, tiles = np.empty(1, np.int32), np.empty(tiling.most, np.uint32)
    cl.enqueue_copy(device.queue, found, to.count)
    cl.enqueue_copy(device.queue, tiles, to.tiles)
    rows, columns = np.nonzero(np.concatenate(expected))
    assert sorted(tiles[: found[0]]) == sorted(rows << 16 | columns)


def reached(marks, tiling, device):
    """For each tile, whether it reads a marked pixel; on a GPU four pixels count as one."""
    first, last = (
        [np.clip(step * (np.arange(n) + i) + add, 0, length - 1) for n, step, length in zip(
            (tiling.rows, tiling.columns), tiling.step, marks.shape, strict=True)]
        for i, add in ((0, -tiling.before), (1, tiling.beyond))
    )  # fmt: skip
    if not device.is_cpu:
        first[1], last[1] = first[1] // 4 * 4, last[1] // 4 * 4 + 3
    return np.array([[marks[y : v + 1, x : u + 1].any() for x, u in zip(first[1], last[1], strict=True)]
                     for y, v in zip(first[0], last[0], strict=True)])  # fmt: skip
