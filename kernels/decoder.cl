// SPDX-License-Identifier: MIT
// Stage decoder, the output: reference stss_ref/decoder.py (outc), stss_ref/resample.py::pixel_shuffle and
// ::upsample_centres.
//
//  buffer   dir  shape           content
//  feature  in   padded, (24)    up3's result
//  color    in   (H8, W8, 4)     see decoder.clh, as weight and bias
//  image    out  (2H, 2W, 3)     pixels beyond 2H, 2W are not written
//
// The buffers may hold a strip of the frame: their row 0 is the frame's row `top`; rows `first_row` .. height - 1 are
// written.
// `tiles`, `count`: the tiles that are computed, see tile_list.clh: of WORKERS x 4 pixels, or of 4 x 4 where
// WORKERS is 1.
//
// Build -D WORKERS (1, or those of a work-group), optionally -D STORED.  Launch (any multiple of WORKERS).
// winograd_image.cl does the same as `image` at the end of up3.
#include "common.clh"
#include "tile_list.clh"
#include "decoder.clh"
#include "image.clh"

#if WORKERS > 1
#define WIDTH WORKERS
#define ROW (6 * WIDTH)  // numbers of a tile in a row of the image

kernel __attribute__((reqd_work_group_size(WORKERS, 1, 1))) void image(
    global const stored *restrict feature, global const float4 *restrict color, global const float8 *restrict weight,
    global const float8 *restrict bias, global float *restrict image, const int height, const int width, const int rows,
    const int columns, const int feature_columns, const int first_row, const int top, global const uint *restrict tiles,
    global const int *restrict count)
{
    local float2 shared[8 * ROW / 2];
    const int item = get_local_id(0);
    for (int t = get_group_id(0); t < count[0]; t += get_num_groups(0)) {
        const int up = 4 * TILE_ROW(tiles[t]), left = WIDTH * TILE_COLUMN(tiles[t]);
        barrier(CLK_LOCAL_MEM_FENCE);
        // The four pixels of a column at once: weights are read once for them.
        const int x = least(left + item, width - 1);
#pragma unroll 1
        for (int lower = 0; lower < 2; ++lower) {
            float8 sums[4];
#pragma unroll
            for (int i = 0; i < 4; ++i) sums[i] = bias[lower];
#pragma unroll 1
            for (int e = 0; e < 3; ++e) {
                float8 f[4];
#pragma unroll
                for (int i = 0; i < 4; ++i)
                    f[i] = LOAD8(feature, ((least(up + i, height - 1) + 1) * feature_columns + x + 1) * 3 + e);
                outc_of_eight(sums, f, lower, weight + 16 * e);
            }
#pragma unroll
            for (int i = 0; i < 4; ++i)
                finish_row(sums[i], color, least(up + i, height - 1), x, lower, rows, columns,
                           shared + ((2 * i + lower) * ROW + 6 * item) / 2);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        // Neighbours store 8 bytes each in a row.
        for (int i = item; i < 8 * ROW / 2; i += WORKERS) {
            const int row = i / (ROW / 2), x = left + i % (ROW / 2) / 3, y = up + row / 2;
            if (y < first_row || y >= height || x >= width) continue;
            ((global float2 *)image)[((2 * (top + up) + row) * width + left) * 3 + i % (ROW / 2)] = shared[i];
        }
    }
}
#else
kernel void image(global const stored *restrict feature, global const float4 *restrict color,
                  global const float8 *restrict weight, global const float8 *restrict bias,
                  global float *restrict image, const int height, const int width, const int rows, const int columns,
                  const int feature_columns, const int first_row, const int top, global const uint *restrict tiles,
                  global const int *restrict count)
{
    const int2 part = part_of_list(count[0], 1);
    for (int t = part.x; t < part.y; ++t) {
        const int x = 4 * TILE_COLUMN(tiles[t]);
        for (int y = 4 * TILE_ROW(tiles[t]), i = 0; i < 4; ++i, ++y) {
            if (y < first_row || y >= height) continue;
            float8 f[12], sums[8];
            // Behind the row's end lie zeros or the next row: these pixels are computed, but not written.
            for (int c = 0; c < 12; ++c) f[c] = LOAD8(feature, ((y + 1) * feature_columns + x + 1) * 3 + c);
            residual((const float *)f, weight, bias, sums);
            write_pixels(sums, color, image, y, x, width, rows, columns, top);
        }
    }
}
#endif
