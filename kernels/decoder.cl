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
// `tiles`, `count`: the tiles of 4 x 4 pixels that are computed, see tile_list.clh.
//
// Build -D WORKERS (16: a pixel each; or 1), optionally -D STORED.  Launch (any multiple of WORKERS).
// winograd.cl -D IMAGE does the same as `image` at the end of up3.
#include "common.clh"
#include "tile_list.clh"
#include "decoder.clh"
#include "image.clh"

kernel void image(global const stored *restrict feature, global const float4 *restrict color,
                  global const float8 *restrict weight, global const float8 *restrict bias,
                  global float *restrict image, const int height, const int width, const int rows, const int columns,
                  const int feature_columns, const int first_row, const int top, global const uint *restrict tiles,
                  global const int *restrict count)
{
    const int2 part = part_of_list(count[0], 1);
    for (int t = part.x; t < part.y; ++t) {
#if WORKERS == 16
        const int y = 4 * TILE_ROW(tiles[t]) + WORKER / 4, x = 4 * TILE_COLUMN(tiles[t]) + WORKER % 4;
        if (y < first_row || y >= height || x >= width) continue;
        const int pixel = ((y + 1) * feature_columns + x + 1) * 3;
#pragma unroll 1
        for (int lower = 0; lower < 2; ++lower) {
            float8 sum = bias[lower];
#pragma unroll 1
            for (int e = 0; e < 3; ++e) sum = outc_of_eight(sum, LOAD8(feature, pixel + e), lower, weight + 16 * e);
            write_row(sum, color, image, y, x, lower, width, rows, columns, top);
        }
#else
        const int x = 4 * TILE_COLUMN(tiles[t]);
        for (int y = 4 * TILE_ROW(tiles[t]), i = 0; i < 4; ++i, ++y) {
            if (y < first_row || y >= height) continue;
            float8 f[12], sums[8];
            // Behind the row's end lie zeros or the next row: these pixels are computed, but not written.
            for (int c = 0; c < 12; ++c) f[c] = LOAD8(feature, ((y + 1) * feature_columns + x + 1) * 3 + c);
            residual((const float *)f, weight, bias, sums);
            write_pixels(sums, color, image, y, x, width, rows, columns, top);
        }
#endif
    }
}
