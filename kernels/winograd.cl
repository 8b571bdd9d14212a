// SPDX-License-Identifier: MIT
// Building block conv, the fast variant of conv.cl for 3 x 3: at stride 1 Winograd F(4x4, 3x3) on the points 0, +-5/8, +-3/2, infinity,
// or F(2x2, 3x3) on 0, +-1, infinity; their constants are exact in float32 (docs/decisions/0011-winograd.md, 0021). At stride 2 see winograd.clh.
//
//  buffer       dir  shape                       content
//  a            in   padded, (A)                 first input, see common.clh; begins at element a_first, a multiple of 8
//  b            in   padded, (B)                 second input, concatenated behind it; not read where B = 0
//  weight       in   (PRODUCTS, LANES / (VECTOR BLOCK), A + B, VECTOR BLOCK)  G w G^T, transformed in float64 by stss_cl/network/pack_weights.py
//  gate_weight  in   (PRODUCTS, A + B)           of the one gate channel; read if GATED, but where a lane behind the outputs has it
//  bias         in   (OUT)
//  out          out  padded, (OUT_CHANNELS)      channels out_first .. out_first + OUT - 1 of it
//
// Build -D STRIDE (1 or 2) -D SIDE (4 or 2: pixels of an output tile's side; 2 at stride 2) -D A -D B -D OUT -D OUT_CHANNELS (multiples of 8)
// -D USED (the inputs behind are zeros) -D TILES (per work-item) -D VECTOR (8 or 16 lanes; LANES is OUT rounded up to it; at 16 TILES is even)
// -D ROWS (tiles held at once, divides TILES) -D BLOCK (vectors of outputs held at once, divides LANES / VECTOR), optionally
// -D PAIRED (winograd_products.clh) -D GATED -D RELU -D HALF -D PREFETCH -D IMAGE (SIDE 4: the decoder's output in place of `out`, see
// decoder.clh; rows `first_row` .. height - 1 are written, rows and columns are those of `color`; row 0 is the frame's row `top`).
// `tiles`, `count`: the tiles of the output, SIDE x SIDE pixels each, that are computed, see tile_list.clh.
// Launch (any number of work-items), work-groups of 1: a work-item takes a strip of TILES after the other, whose scratch stays in L2.
//
// -D MARK: a value is compared with the one that is stored, and `changes`, the output's map, marked where bits came to differ (change_map.clh).
#if !defined(STRIDE) || !defined(SIDE) || !defined(A) || !defined(B) || !defined(OUT) || !defined(OUT_CHANNELS) || !defined(USED) || !defined(TILES) || !defined(ROWS) || !defined(BLOCK) || !defined(VECTOR)
#error "winograd.cl needs -D STRIDE, SIDE, A, B, OUT, OUT_CHANNELS, USED, TILES, ROWS, BLOCK, VECTOR"
#endif
#if (STRIDE != 1 || SIDE != 4) && ((STRIDE != 1 && STRIDE != 2) || SIDE != 2 || defined(IMAGE))
#error "winograd.cl: SIDE is 4, or 2 without IMAGE, or 2 at STRIDE 2"
#endif
#include "common.clh"
#include "winograd_inputs.clh"
#include "winograd_products.clh"
#include "winograd_outputs.clh"
#ifdef IMAGE
#include "decoder.clh"
#endif

kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void winograd(global const stored *restrict a, global const stored *restrict b, global const vec *restrict weight,
              global const float8 *restrict gate_weight, global const float8 *restrict bias, const float gate_bias,
              global stored *restrict out, const int a_first, const int height, const int width, const int in_columns, const int out_columns,
              const int out_first
#ifdef IMAGE
              , global const float4 *restrict color, global const float8 *restrict outc_weight,
              global const float8 *restrict outc_bias, global float *restrict image, const int rows, const int columns,
              const int first_row, const int top
#endif
              , global const uint *restrict tiles, global const int *restrict count
#ifndef IMAGE
              , global uchar *restrict changes
#endif
              )
{
    float8 V[GROUP_ROWS(0) * PATCH * TILES * IN8], M[PRODUCTS * TILES * OUT8];
    vec gates[PRODUCTS * GATES / VECTOR], open[SIDE * SIDE * GATES / VECTOR];  // of no use where not GATED
#ifdef GATED
    for (int i = 0; i < PRODUCTS * GATES / VECTOR; ++i) gates[i] = 0.0f;
#endif
    a += a_first;
    const int2 part = part_of_list(count[0], TILES);
    for (int first = part.x; first < part.y; first += TILES) {
        const int held = least(part.y - first, TILES);
        global const uint *strip = tiles + first;
#ifdef PREFETCH
        const uint next = strip[first + TILES < part.y ? TILES : 0];
#endif

        // A few products at a time, those of a few rows: their inputs then stay in L1.
#pragma unroll
        for (int group = 0; group < GROUPS; ++group) {
            inputs_of(group, a, A, strip, held, in_columns, V);
#if B
            inputs_of(group, b, B, strip, held, in_columns, V + A / 8);
#endif
#pragma nounroll
            for (int product = 0; product < GROUP_ROWS(group) * PATCH; ++product) {
                const int k = GROUP_FIRST(group) * PATCH + product;
                const float8 *inputs = V + product * TILES * IN8;
#ifdef PREFETCH
                // While this strip multiplies, the next one's input and this one's output come into the cache.
                fetch(a, A, STEP * (TILE_ROW(next) * in_columns + TILE_COLUMN(next)), in_columns, PATCH, k);
#if B
                fetch(b, B, STEP * (TILE_ROW(next) * in_columns + TILE_COLUMN(next)), in_columns, PATCH, k);
#endif
#ifndef IMAGE
                fetch(out, OUT_CHANNELS, (SIDE * TILE_ROW(strip[0]) + 1) * out_columns + SIDE * TILE_COLUMN(strip[0]) + 1, out_columns, SIDE, k);
#endif
#endif
                multiply(k, inputs, weight, M, gates);
#if defined(GATED) && !defined(GATE_LANE)
                multiply_gate(k, inputs, gate_weight, gates);
#endif
            }
        }

#ifdef GATED
        for (int t = 0; t < TILES; t += VECTOR)
            open_gates((const float8 *)gates + t / 8, GATES / 8, gate_bias, TILES - t, open + t / VECTOR * SIDE * SIDE);
#endif
        for (int t = 0; t < held; t += TOGETHER(OUT8)) {
#ifdef IMAGE
            float8 features[TOGETHER(OUT8) * SIDE * SIDE * OUT8];
#endif
#pragma unroll
            for (int parity = 0; parity < 2; ++parity) {
#if TOGETHER(OUT8) == 2
#pragma unroll
#else
#pragma nounroll
#endif
                for (int v = 0; v < VECTORS(OUT8); ++v) {
                    const int one = FIRST(OUT8, v), two = SECOND(OUT8, v);
                    vec values[PARITY_ROWS * SIDE];
                    pixels_of(t, v, parity, M, bias, open, values);
#pragma unroll
                    for (int h = 0; h < (LEFT_OVER(OUT8, v) ? EIGHTS : 1); ++h) {
                        const int c = (h ? two : one) % OUT8, its = t + (h ? two : one) / OUT8;
#ifdef IMAGE
#pragma unroll
                        for (int n = 0; n < PARITY_ROWS * SIDE; ++n) {
                            float8 *to = features + ((its - t) * SIDE * SIDE + PLACE(parity, n)) * OUT8 + c;
                            if (LEFT_OVER(OUT8, v))
                                *to = HALF_OF(values[n], h);
                            else
                                *(vec_at_eight *)to = values[n];
                        }
#else
                        if (its >= held) continue;
                        const int x = SIDE * TILE_COLUMN(strip[its]), y = SIDE * TILE_ROW(strip[its]);
                        const int line = out_columns * OUT_CHANNELS;
                        global stored *to = out + (y + parity + 1) * line + (x + 1) * OUT_CHANNELS + out_first + 8 * c;
                        const int whole = y + SIDE <= height && x + SIDE <= width;
                        BEGIN_TILE;
                        if (LEFT_OVER(OUT8, v))
                            WRITE(PUT(HALF_OF(values[n], h), 0, to + AT(n)))
                        else
                            WRITE(PUT_VEC(values[n], to + AT(n)))
                        END_TILE(y / 4 * ((out_columns - 2) / 4) + x / 4);
#endif
                    }
                }
            }
#ifdef IMAGE
            for (int its = t; its < least(t + TOGETHER(OUT8), held); ++its) {
                const int x = SIDE * TILE_COLUMN(strip[its]), y = SIDE * TILE_ROW(strip[its]);
                for (int i = most(first_row - y, 0); i < 4 && y + i < height; ++i) {
                    float8 sums[8];
                    residual((const float *)(features + ((its - t) * SIDE * SIDE + 4 * i) * OUT8), outc_weight, outc_bias, sums);
                    write_pixels(sums, color, image, y + i, x, width, rows, columns, top);
                }
            }
#endif
        }
    }
}
