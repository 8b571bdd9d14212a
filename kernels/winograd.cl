// SPDX-License-Identifier: MIT
// Building block conv, the fast variant of conv.cl for 3 x 3: at stride 1 Winograd F(4x4, 3x3) on the points 0, +-5/8,
// +-3/2, infinity, or F(2x2, 3x3) on 0, +-1, infinity; their constants are exact in float32
// (docs/decisions/0011-winograd.md). At stride 2 see winograd.clh.
//
//  buffer       dir  shape                       content
//  a            in   padded, (A)                 first input, see common.clh; layer.a_first is a multiple of 8
//  b            in   padded, (B)                 second input, concatenated behind it; not read where B = 0
//  weight       in   (PRODUCTS, VECTORS / VECTORS_HELD, A + B, VECTORS_HELD VECTOR)  G w G^T, transformed in float64 by
//                                                                                    stss_cl/network/pack_weights.py
//  gate_weight  in   (PRODUCTS, A + B)           of the one gate channel; read if GATED, unless a lane behind the
//                                                outputs has it
//  bias         in   (OUT)
//  out          out  padded, (OUT_CHANNELS)      OUT channels of it, from layer.out_first on
//
// Build -D STRIDE (1 or 2) -D SIDE (4 or 2: pixels of an output tile's side; 2 at stride 2) -D A -D B -D USED (inputs
// before those whose weights are all 0) -D OUT -D OUT_CHANNELS (multiples of 8) -D TILES (per work-item) -D VECTOR (8
// or 16 lanes; OUT fills VECTORS of them; at 16 TILES is even) -D TILES_HELD (at once in registers, divides TILES) -D
// VECTORS_HELD (of outputs, likewise, divides VECTORS), optionally -D PAIRED (winograd_products.clh) -D GATED -D RELU
// -D STORED -D PREFETCH (of the next strip).
// winograd_image.cl is the same with the decoder's output behind it.
// `tiles`, `count`: the tiles of the output, SIDE x SIDE pixels each, that are computed, see tile_list.clh.
// Launch (any number of work-items), work-groups of 1: a work-item takes one strip of TILES after the other, so its
// scratch stays in L2.
//
// If MARKS(changes), the output's map, a value is compared with the stored one, and marked if bits differ
// (change_map.clh).
#if !defined(STRIDE) || !defined(SIDE) || !defined(A) || !defined(B) || !defined(USED) || !defined(OUT) || \
    !defined(OUT_CHANNELS) || !defined(TILES) || !defined(TILES_HELD) || !defined(VECTORS_HELD) || !defined(VECTOR)
#error "winograd.cl needs -D STRIDE, SIDE, A, B, USED, OUT, OUT_CHANNELS, TILES, TILES_HELD, VECTORS_HELD, VECTOR"
#endif
#if (STRIDE != 1 || SIDE != 4) && ((STRIDE != 1 && STRIDE != 2) || SIDE != 2)
#error "winograd.cl: SIDE is 4, or 2, or 2 at STRIDE 2"
#endif
#include "common.clh"
#include "layer.clh"
#include "winograd_products.clh"
#include "winograd_outputs.clh"

kernel __attribute__((reqd_work_group_size(1, 1, 1))) void winograd(
    global const stored *restrict a, global const stored *restrict b, global const vec *restrict weight,
    global const float8 *restrict gate_weight, global const float8 *restrict bias, const float gate_bias,
    global stored *restrict out, const Layer layer, global const uint *restrict tiles, global const int *restrict count,
    global uchar *restrict changes)
{
    float8 M[PRODUCTS * TILES * OUT8];
    vec gates[PRODUCTS * GATES / VECTOR], open[SIDE * SIDE * GATES / VECTOR];  // unused if not GATED
    clear_gates(gates);
    a += layer.a_first;
    const int2 part = part_of_list(count[0], TILES);
    for (int first = part.x; first < part.y; first += TILES) {
        const TileStrip strip = {tiles + first, least(part.y - first, TILES)};
        const TileStrip next = next_strip(strip, count[0] - first);
        multiply_strip(strip, next, a, b, layer, weight, gate_weight, out, M, gates);
        open_gates(gates, gate_bias, open);
        for (int t = 0; t < strip.held; t += TILES_TOGETHER) {
#pragma unroll
            for (int parity = 0; parity < 2; ++parity) {
                FOR_VECTORS_TOGETHER
                for (int v = 0; v < VECTORS_TOGETHER; ++v) {
                    vec values[PARITY_PIXELS];
                    pixels_of(t, v, parity, M, bias, open, values);
                    store_pixels(strip, t, v, parity, values, out + layer.out_first, layer.height, layer.width,
                                 layer.out_columns, changes);
                }
            }
        }
    }
}
