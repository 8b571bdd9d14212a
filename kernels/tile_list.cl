// SPDX-License-Identifier: MIT
// Lists of tiles (tile_list.clh): the tiles of a layer's output that marked tiles of its inputs reach.
//
//  buffer   dir  shape                 content
//  a, b, c  in   (map_rows, map_columns)  maps of the inputs: 1 = marked, for each 4 x 4 pixels (change_map.clh); a begins at a_tile, and has one for
//                                     each of `images`; b: (b_rows, b_columns), of an input of half the size where b_part is 2
//  tiles    out  (count)               the list, in any order
//  count    out  (1)                   how many; the caller clears it
//
// Tile t of the output, along either axis, reads the pixels step * t - before .. step * (t + 1) + beyond of the inputs; of half the size, those with half
// the step. `rows`, `columns`: of tiles, of each image.
// Build -D SPAN=tiles of a work-item, at most 64.  Launch (ceil(columns / SPAN), rows of all images), or more.
#ifndef SPAN
#error "tile_list.cl needs -D SPAN=tiles of a work-item"
#endif
#include "common.clh"
#include "change_map.clh"

// Whether a mark of the map reaches one of the tiles (y, first .. last).
static inline int reached(global const uchar *map, const int map_rows, const int map_columns, const int step_y, const int step_x,
                          const int before, const int beyond, const int y, const int first, const int last)
{
    const int top = most(step_y * y - before, 0) / 4, bottom = least((step_y * (y + 1) + beyond) / 4, map_rows - 1);
    const int left = most(step_x * first - before, 0) / 4, right = least((step_x * (last + 1) + beyond) / 4, map_columns - 1);
    return marked_tiles(map, map_columns, top, bottom, left, right);
}

kernel void tile_list(global const uchar *restrict a, global const uchar *restrict b, global const uchar *restrict c, const int a_tile,
                      const int map_rows, const int map_columns, const int b_rows, const int b_columns, const int b_part, const int step_y,
                      const int step_x, const int before, const int beyond, const int rows, const int columns, const int images,
                      global uint *restrict tiles, global int *restrict count)
{
    const int first = get_global_id(0) * SPAN, last = least(first + SPAN, columns) - 1, line = get_global_id(1);
    if (first > last || line >= images * rows) return;
    const int image = line / rows, y = line - image * rows, half_y = step_y / b_part, half_x = step_x / b_part;
    const int has_b = b != a, has_c = c != b;
    a += a_tile + image * map_rows * map_columns;
    const int any_a = reached(a, map_rows, map_columns, step_y, step_x, before, beyond, y, first, last);
    const int any_b = has_b && reached(b, b_rows, b_columns, half_y, half_x, before, beyond, y, first, last);
    const int any_c = has_c && reached(c, map_rows, map_columns, step_y, step_x, before, beyond, y, first, last);
    if (!any_a && !any_b && !any_c) return;
    ulong found = 0;
    for (int x = first; x <= last; ++x) {
        const int marked = (any_a && reached(a, map_rows, map_columns, step_y, step_x, before, beyond, y, x, x)) ||
                           (any_b && reached(b, b_rows, b_columns, half_y, half_x, before, beyond, y, x, x)) ||
                           (any_c && reached(c, map_rows, map_columns, step_y, step_x, before, beyond, y, x, x));
        if (marked) found |= 1ul << (x - first);
    }
    int at = found ? atomic_add(count, (int)popcount(found)) : 0;
    for (int x = first; x <= last; ++x)
        if (found >> (x - first) & 1) tiles[at++] = (uint)line << 16 | x;
}
