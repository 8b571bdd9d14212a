// SPDX-License-Identifier: MIT
// The network's last two layers and the image: winograd.cl, SIDE 4 and STRIDE 1, whose outputs become the decoder's
// image (decoder.clh).
//
//  buffer               dir  shape         content
//  a, b, weight, ...    in                 as in winograd.cl
//  color                in   (rows, columns, 4)  the frame that is upsampled and added; row 0 is the frame's row `top`
//  outc_weight, _bias   in   (24, 16), (16)
//  image                out  (2H, 2W, 3)   rows `first_row` .. height - 1 of the buffers are written
//
// Build and launch as winograd.cl.
#include "common.clh"
#include "layer.clh"
#include "winograd_products.clh"
#include "winograd_outputs.clh"
#include "decoder.clh"

kernel __attribute__((reqd_work_group_size(1, 1, 1))) void winograd_image(
    global const stored *restrict a, global const stored *restrict b, global const vec *restrict weight,
    global const float8 *restrict gate_weight, global const float8 *restrict bias, const float gate_bias,
    const Layer layer, global const float4 *restrict color, global const float8 *restrict outc_weight,
    global const float8 *restrict outc_bias, global float *restrict image, const Image shown,
    global const uint *restrict tiles, global const int *restrict count)
{
    float8 M[PRODUCTS * TILES * OUT8], features[TILES_TOGETHER * SIDE * SIDE * OUT8];
    vec gates[PRODUCTS * GATES / VECTOR], open[SIDE * SIDE * GATES / VECTOR];  // unused if not GATED
    clear_gates(gates);
    a += layer.a_first;
    const int2 part = part_of_list(count[0], TILES);
    for (int first = part.x; first < part.y; first += TILES) {
        const TileStrip strip = {tiles + first, least(part.y - first, TILES)};
        const TileStrip next = next_strip(strip, count[0] - first);
        multiply_strip(strip, next, a, b, layer, weight, gate_weight, 0, M, gates);
        open_gates(gates, gate_bias, open);
        for (int t = 0; t < strip.held; t += TILES_TOGETHER) {
#pragma unroll
            for (int parity = 0; parity < 2; ++parity) {
                FOR_VECTORS_TOGETHER
                for (int v = 0; v < VECTORS_TOGETHER; ++v) {
                    vec values[PARITY_PIXELS];
                    pixels_of(t, v, parity, M, bias, open, values);
                    hold_pixels(v, parity, values, features);
                }
            }
            for (int i = t; i < least(t + TILES_TOGETHER, strip.held); ++i) {
                const int x = SIDE * TILE_COLUMN(strip.tiles[i]), y = SIDE * TILE_ROW(strip.tiles[i]);
                for (int row = most(shown.first_row - y, 0); row < SIDE && y + row < layer.height; ++row) {
                    float8 sums[8];
                    residual((const float *)(features + ((i - t) * SIDE * SIDE + SIDE * row) * OUT8), outc_weight,
                             outc_bias, sums);
                    write_pixels(sums, color, image, y + row, x, layer.width, shown.rows, shown.columns, shown.top);
                }
            }
        }
    }
}
