// SPDX-License-Identifier: MIT
// Building block resample: x2 with corners aligned, reference stss_ref/resample.py::upsample_corners.
//
//  buffer  dir  shape               content
//  in      in   padded, (8 eights)  see common.clh
//  out     out  padded, (8 eights)  twice the size
//
// Output o of N = 2n reads input position o (n - 1) / (N - 1): an integer quotient and its remainder, so that the weight is rounded
// once however large the frame. The buffers may hold a strip of the frame: their row 0 is row `top` of `full_height` (2 `top` of the
// output).
// `tiles`, `count`: the tiles of 4 x 4 pixels of the output that are computed, see tile_list.clh.
// Build -D WORKERS (16 or 1), optionally -D STORED, -D PREFETCH (of what is compared).  Launch (any multiple of WORKERS).
//
// Where MARKS(changes), the output's map, a value is compared with the one that is stored, and marked where bits came to differ (change_map.clh).
#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"
#include "tile_list.clh"

// The two of `count` values along an axis that an output lies between, and its place between them.
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

// Of a tile's row, those of one work-item.
#define COLUMNS (WORKERS == 1 ? 4 : 1)

kernel void upsample_corners(global const stored *restrict in, global stored *restrict out, const int height, const int width,
                             const int in_columns, const int out_columns, const int full_height, const int top, const int eights,
                             global const uint *restrict tiles, global const int *restrict count, global uchar *restrict changes)
{
    const int2 part = part_of_list(count[0], 1);
    for (int t = part.x; t < part.y; ++t) {
        const int up = 4 * TILE_ROW(tiles[t]), left = 4 * TILE_COLUMN(tiles[t]);
#ifdef PREFETCH
        if (MARKS(changes)) {
            // What is compared is read before it is written, and that would wait for memory: the tile after the next one, line by line.
            const uint soon = tiles[least(t + 2, count[0] - 1)];
            for (int y = 1; y <= 4; ++y) {
                global const stored *line = out + ((4 * TILE_ROW(soon) + y) * out_columns + 4 * TILE_COLUMN(soon) + 1) * 8 * eights;
                for (int i = 0; i < 32 * eights; i += 64 / sizeof(stored)) __builtin_prefetch((const void *)(size_t)(line + i), 1, 2);
            }
        }
#endif
        // One quotient for each row and column of the tile: it takes as long as a pixel.
        Between across[COLUMNS];
#pragma unroll
        for (int j = 0; j < COLUMNS; ++j) across[j] = between(left + WORKER % 4 + j, width, width, 0);
        for (int y = up + WORKER / 4; y < least(up + 4, 2 * height); y += COLUMNS == 4 ? 1 : 4) {
            const Between v = between(y, height, full_height, top);
            const int upper = (v.first + 1) * in_columns + 1, lower = (v.second + 1) * in_columns + 1;
            for (int j = 0; j < COLUMNS; ++j) {
                const int x = left + WORKER % 4 + j;
                if (x >= 2 * width) break;
                const Between u = across[j];
                BEGIN_PIXEL;
                for (int c = 0; c < eights; ++c) {
                    const float8 nw = LOAD8(in, (upper + u.first) * eights + c), ne = LOAD8(in, (upper + u.second) * eights + c);
                    const float8 sw = LOAD8(in, (lower + u.first) * eights + c), se = LOAD8(in, (lower + u.second) * eights + c);
                    // First down, then across, as the reference.
                    const float8 west = nw + (sw - nw) * v.share, east = ne + (se - ne) * v.share;
                    const float8 value = west + (east - west) * u.share;
                    PUT(value, ((y + 1) * out_columns + x + 1) * eights + c, out);
                }
                END_PIXEL(y * (out_columns - 2) + x);
            }
        }
    }
}
