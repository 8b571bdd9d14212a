// SPDX-License-Identifier: MIT
// Building block resample: x2 with corners aligned, reference stss_ref/resample.py::upsample_corners.
//
//  buffer  dir  shape               content
//  in      in   padded, (8 EIGHTS)  see common.clh
//  out     out  padded, (8 EIGHTS)  twice the size
//
// Output o of N = 2n reads input position o (n - 1) / (N - 1): an integer quotient and its remainder. So the weight is
// rounded once, for frames of any size. The buffers may hold a strip of the frame: their row 0 is row `top` of
// `full_height` (2 `top` of the output).
// `tiles`, `count`: the tiles of 32 x 4 pixels of the output that are computed; see tile_list.clh.
// Build -D EIGHTS -D WORKERS (1, or those of a work-group), optionally -D STORED, -D PREFETCH (of compared values).
// Launch (any multiple of WORKERS).
//
// If MARKS(changes), the output's map, a value is compared with the stored one, and marked if bits differ
// (change_map.clh).
#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"
#include "tile_list.clh"

// The two neighbours of an output among `count` values along an axis, and its place between them.
typedef struct {
    int first, second;
    float share;
} Between;

// Output o of 2 count; a strip's row 0 is `top` of `full`.
static inline Between between(const int o, const int count, const int full, const int top)
{
    const int along = (2 * top + o) * (full - 1), whole = along / (2 * full - 1);
    const int first = least(most(whole - top, 0), count - 1);
    const Between at = {first, least(first + 1, count - 1), (along - whole * (2 * full - 1)) / (2 * full - 1.0f)};
    return at;
}

#define WIDTH 32

#if WORKERS == 1

kernel __attribute__((reqd_work_group_size(1, 1, 1))) void upsample_corners(
    global const stored *restrict in, global stored *restrict out, const int height, const int width,
    const int in_columns, const int out_columns, const int full_height, const int top,
    global const uint *restrict tiles, global const int *restrict count, global uchar *restrict changes)
{
    // A row of the tile, interpolated down only: the columns of the input that the tile reads.
    float8 down[(WIDTH / 2 + 2) * EIGHTS];
    const int2 part = part_of_list(count[0], 1);
    for (int t = part.x; t < part.y; ++t) {
        const int up = 4 * TILE_ROW(tiles[t]), left = WIDTH * TILE_COLUMN(tiles[t]),
                  pixels = least(2 * width - left, WIDTH);
#ifdef PREFETCH
        if (MARKS(changes)) {
            // A value is read for the comparison before it is written, which would wait for memory: so prefetch the
            // next tile, line by line.
            const uint soon = tiles[least(t + 1, count[0] - 1)];
            for (int y = 1; y <= 4; ++y) {
                global const stored *line =
                    out + ((4 * TILE_ROW(soon) + y) * out_columns + WIDTH * TILE_COLUMN(soon) + 1) * 8 * EIGHTS;
                for (int i = 0; i < WIDTH * 8 * EIGHTS; i += 64 / sizeof(stored))
                    __builtin_prefetch((const void *)(size_t)(line + i), 1, 2);
            }
        }
#endif
        const Between leftmost = between(left, width, width, 0),
                      rightmost = between(left + pixels - 1, width, width, 0);
        const int used = rightmost.second - leftmost.first + 1, whole = 2 * width - 1;
        const int rest = left * (width - 1) - leftmost.first * whole;
        for (int y = up; y < least(up + 4, 2 * height); ++y) {
            const Between v = between(y, height, full_height, top);
            const int upper = ((v.first + 1) * in_columns + 1 + leftmost.first) * EIGHTS,
                      lower = ((v.second + 1) * in_columns + 1 + leftmost.first) * EIGHTS;
            for (int i = 0; i < used * EIGHTS; ++i) {
                const float8 north = LOAD8(in, upper + i), south = LOAD8(in, lower + i);
                down[i] = north + (south - north) * v.share;
            }
            // From one output to the next the quotient grows by 0 or 1, as in `between`.
            for (int j = 0, first = 0, over = rest; j < pixels; ++j, over += width - 1) {
                if (over >= whole) over -= whole, ++first;
                const float share = over / (float)whole;
                const float8 *west = down + first * EIGHTS, *east = down + least(first + 1, used - 1) * EIGHTS;
                BEGIN_PIXEL;
#pragma unroll
                for (int c = 0; c < EIGHTS; ++c)
                    PUT(west[c] + (east[c] - west[c]) * share, ((y + 1) * out_columns + left + j + 1) * EIGHTS + c,
                        out);
                END_PIXEL(y * (out_columns - 2) + left + j);
            }
        }
    }
}
#else
kernel __attribute__((reqd_work_group_size(WORKERS, 1, 1))) void upsample_corners(
    global const stored *restrict in, global stored *restrict out, const int height, const int width,
    const int in_columns, const int out_columns, const int full_height, const int top,
    global const uint *restrict tiles, global const int *restrict count, global uchar *restrict changes)
{
    for (int t = get_group_id(0); t < count[0]; t += get_num_groups(0)) {
        const int up = 4 * TILE_ROW(tiles[t]), left = WIDTH * TILE_COLUMN(tiles[t]);
        // Eights of a pixel, then pixels of a row: neighbours store 16 or 32 bytes each in a row.
        for (int i = get_local_id(0); i < 4 * WIDTH * EIGHTS; i += WORKERS) {
            const int c = i % EIGHTS, x = left + i / EIGHTS % WIDTH, y = up + i / EIGHTS / WIDTH;
            if (y >= 2 * height || x >= 2 * width) continue;
            const Between u = between(x, width, width, 0), v = between(y, height, full_height, top);
            const int upper = (v.first + 1) * in_columns + 1, lower = (v.second + 1) * in_columns + 1;
            const float8 nw = LOAD8(in, (upper + u.first) * EIGHTS + c),
                         ne = LOAD8(in, (upper + u.second) * EIGHTS + c);
            const float8 sw = LOAD8(in, (lower + u.first) * EIGHTS + c),
                         se = LOAD8(in, (lower + u.second) * EIGHTS + c);
            // First down, then across, as the reference.
            const float8 west = nw + (sw - nw) * v.share, east = ne + (se - ne) * v.share;
            BEGIN_PIXEL;
            PUT(west + (east - west) * u.share, ((y + 1) * out_columns + x + 1) * EIGHTS + c, out);
            END_PIXEL(y * (out_columns - 2) + x);
        }
    }
}
#endif
