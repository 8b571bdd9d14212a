// SPDX-License-Identifier: MIT
// Lists of tiles (tile_list.clh): the tiles of a layer's output that marked pixels of its inputs reach.
//
//  buffer   dir  shape                    content
//  a, b, c  in   (map_rows, map_columns)  maps of the inputs: not 0 = marked, for each pixel (change_map.clh); a begins
//                                         at a_first, and has one map for each of `images`
//  tiles    out  (count)                  the list, in any order
//  count    out  (1)                      its length; the caller clears it
//
// Tile t of the output, along either axis, reads the pixels step * t - before .. step * (t + 1) + beyond of the inputs.
// `rows`, `columns`: of tiles, of each image; `span`: tiles of a work-item, at most 64.
// Build for processors -D SPAN_PIXELS=a multiple of 64, the most that `span` steps take; without it `span` is 1, and
// fours of pixels count as one.
// Launch (ceil(columns / span), rows of all images), or more.
#include "common.clh"
#include "change_map.clh"

#define MOST_BEFORE 8

// The tiles of the output and the part of the maps that they read, see above.
typedef struct {
    int a_first, map_rows, map_columns;
    int step_y, step_x, before, beyond;
    int rows, columns, images, span;
} Reach;

#ifdef SPAN_PIXELS
typedef ulong ulong_anywhere __attribute__((aligned(1)));
typedef ulong8 ulong8_anywhere __attribute__((aligned(1)));

// Marks of 64 pixels in any of the rows top .. bottom.
static inline ulong8 marks(global const uchar *map, const int columns, const int top, const int bottom)
{
    ulong8 any = 0;
    for (int y = top; y <= bottom; ++y) any |= *(global const ulong8_anywhere *)(map + y * columns);
    return any;
}
#else
// Whether a pixel of the rows top .. bottom is marked, from `left` to `right`.
static inline bool any_marked(global const uchar *map, const int columns, const int top, const int bottom,
                              const int left, const int right)
{
    uint any = 0;
    for (int y = top; y <= bottom; ++y)
        for (int i = (y * columns + left) / 4; i <= (y * columns + right) / 4; ++i)
            any |= ((global const uint *)map)[i];
    return any != 0;
}
#endif

kernel void tile_list(global const uchar *restrict a, global const uchar *restrict b, global const uchar *restrict c,
                      const Reach reach, global uint *restrict tiles, global int *restrict count)
{
    const int first = get_global_id(0) * reach.span, last = least(first + reach.span, reach.columns) - 1,
              row = get_global_id(1);
    if (first > last || row >= reach.images * reach.rows) return;
    const int image = row / reach.rows, y = row - image * reach.rows, start = reach.step_x * first;
    const int top = most(reach.step_y * y - reach.before, 0),
              bottom = least(reach.step_y * (y + 1) + reach.beyond, reach.map_rows - 1);
    const int left = most(start - reach.before, 0),
              right = least(reach.step_x * (last + 1) + reach.beyond, reach.map_columns - 1);
    const bool has_b = b != a, has_c = c != b;
    a += reach.a_first + image * reach.map_rows * reach.map_columns;
#ifdef SPAN_PIXELS
    // The marks of all rows and maps; 0 beyond the frame. The first tile's own pixels begin at MOST_BEFORE.
    uchar line[MOST_BEFORE + SPAN_PIXELS + 3 * 64];
    ulong8 all = 0;
    *(ulong *)line = 0;
    uchar *to = line + MOST_BEFORE - start;
    for (int x = left; x <= right; x += 64) {
        ulong8 any = marks(a + x, reach.map_columns, top, bottom);
        if (has_b) any |= marks(b + x, reach.map_columns, top, bottom);
        if (has_c) any |= marks(c + x, reach.map_columns, top, bottom);
        *(ulong8_anywhere *)(to + x) = any;
        all |= any;
    }
    const ulong4 four = all.lo | all.hi;
    if ((four.x | four.y | four.z | four.w) == 0) return;
    *(ulong8_anywhere *)(to + right + 1) = 0;
    ulong found = 0;
    for (int i = -reach.before; i <= reach.step_x + reach.beyond; i += 8) {
        const ulong read =
            i + 7 <= reach.step_x + reach.beyond ? ~0ul : ~0ul >> 8 * (i + 7 - reach.step_x - reach.beyond);
        const uchar *from = line + MOST_BEFORE + i;
        for (int x = 0; x <= last - first; ++x)
            found |= (ulong)((*(const ulong_anywhere *)(from + reach.step_x * x) & read) != 0) << x;
    }
    if (!found) return;
    // Without branches: the entry of a tile that is not marked is overwritten.
    int at = atomic_add(count, (int)popcount(found));
    for (int x = 0; x <= last - first && found >> x; ++x) {
        tiles[at] = (uint)row << 16 | (first + x);
        at += found >> x & 1;
    }
#else
    if (any_marked(a, reach.map_columns, top, bottom, left, right) ||
        (has_b && any_marked(b, reach.map_columns, top, bottom, left, right)) ||
        (has_c && any_marked(c, reach.map_columns, top, bottom, left, right)))
        tiles[atomic_inc(count)] = (uint)row << 16 | first;
#endif
}
