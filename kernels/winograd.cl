// Building block conv, the fast variant of conv.cl for 3 x 3: at stride 1 Winograd F(4x4, 3x3) on the points 0, +-5/8, +-3/2, infinity,
// or F(2x2, 3x3) on 0, +-1, infinity; their constants are exact in float32 (docs/decisions/0011-winograd.md, 0021). At stride 2 see winograd.clh.
//
//  buffer       dir  shape                       content
//  a            in   padded, (A)                 first input, see common.clh; begins at element a_first, a multiple of 8
//  b            in   padded, (B)                 second input, concatenated behind it; not read where B = 0
//  weight       in   (PRODUCTS, OUT / (8 BLOCK), A + B, 8 BLOCK)  G w G^T, transformed in float64 by stss_cl/network/pack_weights.py
//  gate_weight  in   (PRODUCTS, A + B)           of the one gate channel; read if GATED
//  bias         in   (OUT)
//  out          out  padded, (out_channels)      channels out_first .. out_first + OUT - 1 of it
//
// Build -D STRIDE (1 or 2) -D SIDE (4 or 2: pixels of an output tile's side; 2 at stride 2) -D A -D B -D OUT (multiples of 8) -D USED (the inputs behind are zeros) -D TILES (per
// work-item) -D ROWS (tiles held at once, divides TILES) -D BLOCK (float8 of outputs held at once, divides OUT / 8), optionally
// -D GATED -D RELU -D HALF -D PREFETCH -D IMAGE (SIDE 4: the decoder's output in place of `out`, see decoder.clh; rows `first_row` .. height - 1
// are written, rows and columns are those of `color`; row 0 is the frame's row `top`).
// `tiles`, `count`: the tiles of the output, SIDE x SIDE pixels each, that are TILES, see tile_list.clh.
// Launch (any number of work-items), work-groups of 1: a work-item takes a strip of TILES after the other, whose scratch stays in L2.
//
// -D MARK: a value is compared with the one that is stored, and `changes`, the output's map, marked where bits came to differ (change_map.clh).
#if !defined(STRIDE) || !defined(SIDE) || !defined(A) || !defined(B) || !defined(OUT) || !defined(USED) || !defined(TILES) || !defined(ROWS) || !defined(BLOCK)
#error "winograd.cl needs -D STRIDE, SIDE, A, B, OUT, USED, TILES, ROWS, BLOCK"
#endif
#if (STRIDE != 1 || SIDE != 4) && ((STRIDE != 1 && STRIDE != 2) || SIDE != 2 || defined(IMAGE))
#error "winograd.cl: SIDE is 4, or 2 without IMAGE, or 2 at STRIDE 2"
#endif
#include "common.clh"
#include "tile_list.clh"
#include "winograd.clh"
#ifdef IMAGE
#include "decoder.clh"
#endif

#define IN (A + B)
#define IN8 (IN / 8)
#define OUT8 (OUT / 8)
#define PAIRS ((TILES + 1) / 2)

#ifdef PREFETCH
// The k-th of PRODUCTS parts of `rows` rows (PATCH of STEP pixels a tile, or SIDE of SIDE) of a strip of tiles: line by line, for OpenCL's own
// prefetch() does nothing on PoCL. PRODUCTS is a multiple of the rows, or one more: then the last part is a row too far, which is read soon.
static inline void fetch(global const stored *buffer, const int channels, const int pixel, const int columns, const int rows, const int k)
{
    const int line = 64 / sizeof(stored), lines = (rows == PATCH ? STEP : SIDE) * TILES * channels / line;
    const int parts = PRODUCTS / rows, part = (lines + parts - 1) / parts;  // known when it is compiled
    global const stored *from = buffer + (pixel + k / parts * columns) * channels + k % parts * part * line;
#pragma unroll
    for (int i = 0; i < part; ++i) __builtin_prefetch((const void *)(size_t)(from + i * line));
}
#endif

kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void winograd(global const stored *restrict a, global const stored *restrict b, global const float8 *restrict weight,
              global const float8 *restrict gate_weight, global const float8 *restrict bias, const float gate_bias,
              global stored *restrict out, const int a_first, const int height, const int width, const int in_columns, const int out_columns,
              const int out_channels, const int out_first
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
#ifdef GATED
    float8 gates[PRODUCTS * PAIRS];
    float4 open4[2 * PAIRS * SIDE * SIDE / 4];
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
            for (int t = 0; t < TILES; ++t) {
                const uint tile = strip[least(t, held - 1)];  // the last strip is filled up with its last tile
                const int corner = STEP * (TILE_ROW(tile) * in_columns + TILE_COLUMN(tile));
                float8 *to = V + t * IN8;
#pragma nounroll
                for (int c = 0; c < A / 8; ++c) input_rows(group, a + corner * A + 8 * c, in_columns * A, A, to + c, TILES * IN8);
#if B
#pragma nounroll
                for (int c = 0; c < B / 8; ++c) input_rows(group, b + corner * B + 8 * c, in_columns * B, B, to + A / 8 + c, TILES * IN8);
#endif
            }
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
                fetch(out, out_channels, (SIDE * TILE_ROW(strip[0]) + 1) * out_columns + SIDE * TILE_COLUMN(strip[0]) + 1, out_columns, SIDE, k);
#endif
#endif
                for (int block = 0; block < OUT8; block += BLOCK) {
                    global const float8 *restrict w = weight + (k * OUT8 + block) * IN;
                    for (int t = 0; t < TILES; t += ROWS) {
                        const float *v = (const float *)(inputs + t * IN8);
                        float8 sum[ROWS * BLOCK];
#pragma unroll
                        for (int i = 0; i < ROWS * BLOCK; ++i) sum[i] = 0.0f;
                        for (int c = 0; c < USED; ++c) {
                            float8 wc[BLOCK];
#pragma unroll
                            for (int j = 0; j < BLOCK; ++j) wc[j] = w[c * BLOCK + j];
#pragma unroll
                            for (int r = 0; r < ROWS; ++r) {
                                const float8 value = (float8)(v[r * IN + c]);
#pragma unroll
                                for (int j = 0; j < BLOCK; ++j) sum[r * BLOCK + j] += value * wc[j];
                            }
                        }
#pragma unroll
                        for (int i = 0; i < ROWS * BLOCK; ++i)
                            M[(k * TILES + t + i / BLOCK) * OUT8 + block + i % BLOCK] = sum[i];
                    }
                }
#ifdef GATED
                // The output transform is linear: it may run on partial sums, which are added only at its end; four of each of two tiles.
                for (int t = 0; t < TILES; t += 2) {
                    const float8 *v = inputs + t * IN8;
                    const int other = t + 1 < TILES ? IN8 : 0;
                    float8 one = 0.0f, two = 0.0f;
#pragma unroll
                    for (int c = 0; c < IN8; ++c) {
                        one += v[c] * gate_weight[k * IN8 + c];
                        two += v[other + c] * gate_weight[k * IN8 + c];
                    }
                    gates[k * PAIRS + t / 2] = (float8)(one.lo, two.lo) + (float8)(one.hi, two.hi);
                }
#endif
            }
        }

#ifdef GATED
        for (int t = 0; t < TILES; t += 2) open_gates(gates + t / 2, PAIRS, gate_bias, open4 + t * SIDE * SIDE / 4);
#endif
        for (int t = 0; t < held; ++t) {
            const int x = SIDE * TILE_COLUMN(strip[t]), y = SIDE * TILE_ROW(strip[t]);
            BEGIN_TILE;
#ifdef GATED
            const float *open = (const float *)(open4 + t * SIDE * SIDE / 4);
#endif
#ifdef IMAGE
            float8 features[SIDE * SIDE * OUT8];
#endif
#pragma unroll
            for (int parity = 0; parity < 2; ++parity) {
#pragma nounroll
                for (int c = 0; c < OUT8; ++c) {
                    const float8 shift = bias[c];
                    float8 values[PARITY_ROWS * SIDE];
                    output_rows(parity, M + t * OUT8 + c, TILES * OUT8, values);
#pragma unroll
                    for (int n = 0; n < PARITY_ROWS * SIDE; ++n) {
                        values[n] += shift;
#ifdef GATED
                        values[n] *= open[PLACE(parity, n)];
#endif
#ifdef RELU
                        values[n] = relu8(values[n]);
#endif
#ifdef IMAGE
                        features[PLACE(parity, n) * OUT8 + c] = values[n];
#endif
                    }
#ifndef IMAGE
                    const int line = out_columns * out_channels;
                    global stored *to = out + (y + parity + 1) * line + (x + 1) * out_channels + out_first + 8 * c;
                    if (y + SIDE <= height && x + SIDE <= width) {
#pragma unroll
                        for (int n = 0; n < PARITY_ROWS * SIDE; ++n) PUT(values[n], n % SIDE * out_channels / 8, to + n / SIDE * 2 * line);
                    } else {
#pragma unroll
                        for (int n = 0; n < PARITY_ROWS * SIDE; ++n)
                            if (y + parity + n / SIDE * 2 < height && x + n % SIDE < width)
                                PUT(values[n], n % SIDE * out_channels / 8, to + n / SIDE * 2 * line);
                    }
#endif
                }
            }
#ifdef IMAGE
            for (int i = most(first_row - y, 0); i < 4 && y + i < height; ++i) {
                float8 sums[8];
                residual((const float *)(features + 4 * i * OUT8), outc_weight, outc_bias, sums);
                write_pixels(sums, color, image, y + i, x, width, rows, columns, top);
            }
#endif
            END_TILE(y / 4 * ((out_columns - 2) / 4) + x / 4);
        }
    }
}
