// SPDX-License-Identifier: MIT
// Lists of tiles (tile_list.clh): the tiles of a layer's output that marked tiles of its inputs reach.
//
//  buffer   dir  shape                 content
//  a, b, c  in   (map_rows, map_columns)  maps of the inputs: 1 = marked, for each 4 x 4 pixels (change_map.clh); a begins at a_tile
//  tiles    out  (count)               the list, in any order
//  count    out  (1)                   how many; the caller clears it
//
// Tile t of the output, along either axis, reads the pixels step * t - before .. step * (t + 1) + beyond of the inputs. `rows`, `columns`: of tiles.
// `unmarked`: list those that no marked tile reaches instead.
// Build -D SPAN=tiles of a work-item, at most 64.  Launch (ceil(columns / SPAN), rows), or more.
#ifndef SPAN
#error "tile_list.cl needs -D SPAN=tiles of a work-item"
#endif
#include "common.clh"
#include "change_map.clh"

kernel void tile_list(global const uchar *restrict a, global const uchar *restrict b, global const uchar *restrict c, const int a_tile,
                      const int map_rows, const int map_columns, const int step_y, const int step_x, const int before, const int beyond,
                      const int rows, const int columns, const int unmarked, global uint *restrict tiles, global int *restrict count)
{
    const int first = get_global_id(0) * SPAN, last = least(first + SPAN, columns) - 1, y = get_global_id(1);
    if (first > last || y >= rows) return;
    a += a_tile;
    const int top = most(step_y * y - before, 0) / 4, bottom = least((step_y * (y + 1) + beyond) / 4, map_rows - 1);
    const int left = most(step_x * first - before, 0) / 4, right = least((step_x * (last + 1) + beyond) / 4, map_columns - 1);
    const int any_a = marked_tiles(a, map_columns, top, bottom, left, right);
    const int any_b = b != a && marked_tiles(b, map_columns, top, bottom, left, right);
    const int any_c = c != b && marked_tiles(c, map_columns, top, bottom, left, right);
    if (!unmarked && !any_a && !any_b && !any_c) return;
    ulong found = 0;
    for (int x = first; x <= last; ++x) {
        const int west = most(step_x * x - before, 0) / 4, east = least((step_x * (x + 1) + beyond) / 4, map_columns - 1);
        const int reached = (any_a && marked_tiles(a, map_columns, top, bottom, west, east)) ||
                            (any_b && marked_tiles(b, map_columns, top, bottom, west, east)) ||
                            (any_c && marked_tiles(c, map_columns, top, bottom, west, east));
        if (reached != unmarked) found |= 1ul << (x - first);
    }
    int at = found ? atomic_add(count, (int)popcount(found)) : 0;
    for (int x = first; x <= last; ++x)
        if (found >> (x - first) & 1) tiles[at++] = (uint)y << 16 | x;
}
