// SPDX-License-Identifier: MIT
// Building block conv on a processor's matrix units, reference stss_ref/conv.py::conv and ::gated: 3 x 3, stride 1 or 2, activations and weights in
// bfloat16, sums in float. Buffers and arguments as in conv.cl, but
//
//  weight  in  (STEPS(A) + STEPS(B) for each row of taps, PARTS, 16, 16, 2) of bfloat16: tiles of 32 inputs x 16 outputs; output OUT is the gate
//  bias    in  (16 PARTS)  of the outputs and of the gate
//
// Three taps of a row are 3 C values side by side, so 16 pixels x 32 of these values are one tile, whose rows are STRIDE pixels apart. What a row's
// last step reads beyond them meets weights of 0. An output's sum depends on its own inputs alone, so tiles may be left out.
// Build -D STORED=BFLOAT16 -D A -D B -D OUT (multiples of 8; A may be 4) -D STRIDE, optionally -D EMULATE (amx.clh) -D GATED -D RELU -D MARK (change_map.clh).
// -D IMAGE, where OUT is 24: what would be stored goes through outc and becomes the image; color and what follows as in winograd_image.cl.
// Launch (any number of work-items), work-groups of 1, over tiles of 32 x 4 pixels (tile_list.clh).
#if !defined(A) || !defined(B) || !defined(OUT) || !defined(STRIDE)
#error "conv_amx.cl needs -D A, B, OUT, STRIDE"
#endif
#include "common.clh"
#include "tile_list.clh"
#include "amx.clh"
#ifdef IMAGE
#include "decoder.clh"
#define TO_PARAMS global const float4 *restrict color, global const float8 *restrict outc_weight, global const float8 *restrict outc_bias, \
    global float *restrict image, const int rows, const int columns, const int first_row, const int top
#define TO color, outc_weight, outc_bias, image, rows, columns, first_row, top
#endif

#ifdef GATED
#define PARTS (OUT / 16 + 1)
#else
#define PARTS ((OUT + 15) / 16)
#endif
#define STEPS(channels) ((3 * (channels) + 31) / 32)
#define ACROSS 32
#define TILE_VALUES 512  // bfloat16 of a tile

#if STORED != BFLOAT16
#error "conv_amx.cl needs -D STORED=BFLOAT16"
#endif

// Brings the part-th of 12 parts of a tile's input into the cache: 32 pixels of a row of taps, for four rows of pixels.
static inline void fetch(global const stored *from, const int channels, const int line, const int part)
{
#ifndef EMULATE
    global const stored *row = from + part % 3 * line + part / 3 * STRIDE * line;
    for (int i = 0; i < STRIDE * ACROSS * channels; i += 32) __builtin_prefetch((const void *)(size_t)(row + i), 0, 3);
#endif
}

// Of 2 x 16 pixels, the products of one input with one or two parts of the outputs are added to tiles 0 .. 3; defined as a macro since tiles have
// numbers, no addresses.
#define PRODUCTS(from, channels, line, weights, two)                                                         \
    for (int tap = 0; tap < 3; ++tap)                                                                        \
        for (int step = 0; step < STEPS(channels); ++step) {                                                 \
            global const stored *pixels = (from) + tap * (line) + 32 * step;                                 \
            global const stored *w = (weights) + (tap * STEPS(channels) + step) * PARTS * TILE_VALUES;       \
            TILE_LOAD(4, pixels, 2 * STRIDE * (channels));                                                   \
            TILE_LOAD(5, pixels + 16 * STRIDE * (channels), 2 * STRIDE * (channels));                        \
            TILE_LOAD(6, w, 64);                                                                             \
            TILE_MULTIPLY(0, 4, 6);                                                                          \
            TILE_MULTIPLY(1, 5, 6);                                                                          \
            if (two) {                                                                                       \
                TILE_LOAD(7, w + TILE_VALUES, 64);                                                           \
                TILE_MULTIPLY(2, 4, 7);                                                                      \
                TILE_MULTIPLY(3, 5, 7);                                                                      \
            }                                                                                                \
        }

#ifdef IMAGE
// ReLU, rounding, outc: writes the image of a row's pixels from x on, whose sums lie by part, pixel and output.
static inline void finish_image(const float *sums, const int y, const int x, const int width, TO_PARAMS)
{
    for (int first = 0; first < least(width - x, ACROSS) && y >= first_row; first += 4) {
        float8 features[12], residuals[8];
        for (int i = 0; i < 12; ++i)
            features[i] = widen8(narrow8(relu8(*(const float8 *)(sums + (i % 3 / 2 * ACROSS + first + i / 3) * 16 + i % 3 % 2 * 8))));
        residual((const float *)features, outc_weight, outc_bias, residuals);
        write_pixels(residuals, color, image, y, x + first, width, rows, columns, top);
    }
}
#endif

// Gate, ReLU, rounding: stores `pixels` pixels from (y, x) on, whose sums lie by part, pixel and output.
static inline void finish(const float *sums, const int y, const int x, const int pixels, global stored *out, const int out_columns,
                          const int out_channels, global uchar *changes)
{
#ifdef GATED
    float open[ACROSS] __attribute__((aligned(32)));
    for (int p = 0; p < ACROSS; ++p) open[p] = sums[(OUT / 16 * ACROSS + p) * 16 + OUT % 16];
    for (int i = 0; i < ACROSS / 8; ++i) ((float8 *)open)[i] = sigmoid8(((const float8 *)open)[i]);
#endif
    for (int p = 0; p < pixels; ++p) {
        BEGIN_PIXEL;
        for (int c = 0; c < OUT / 8; ++c) {
            float8 value = *(const float8 *)(sums + (c / 2 * ACROSS + p) * 16 + c % 2 * 8);
#ifdef GATED
            value *= open[p];
#endif
#ifdef RELU
            value = relu8(value);
#endif
            PUT(value, ((y + 1) * out_columns + x + p + 1) * (out_channels / 8) + c, out);
        }
        END_PIXEL(y * (out_columns - 2) + x + p);
    }
}

kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void conv_amx(global const stored *restrict a, global const stored *restrict b, global const stored *restrict weight,
              global const stored *restrict gate_weight, global const float *restrict bias, const float gate_bias,
#ifdef IMAGE
              const int a_first, const int height, const int width, const int in_columns, TO_PARAMS, global const uint *restrict tiles,
              global const int *restrict count)
#else
              global stored *restrict out, const int a_first, const int height, const int width, const int in_columns, const int out_columns,
              const int out_channels, const int out_first, global const uint *restrict tiles, global const int *restrict count,
              global uchar *restrict changes)
#endif
{
    TILES_BEGIN;
    float sums[PARTS * ACROSS * 16] __attribute__((aligned(64)));
    a += a_first;
    const int2 part = part_of_list(count[0], 1);
    for (int t = part.x; t < part.y; ++t) {
        const uint ahead = tiles[least(t + 1, part.y - 1)];
        const int next = STRIDE * (4 * TILE_ROW(ahead) * in_columns + ACROSS * TILE_COLUMN(ahead));
        const int x = ACROSS * TILE_COLUMN(tiles[t]);
        for (int row = 0; row < 4; ++row) {
            const int y = 4 * TILE_ROW(tiles[t]) + row, corner = STRIDE * (y * in_columns + x);
            if (y >= height) break;
            for (int tap = 0; tap < 3; ++tap) {
                fetch(a + next * A, A, in_columns * A, 3 * row + tap);
#if B
                fetch(b + next * B, B, in_columns * B, 3 * row + tap);
#endif
            }
            for (int n = 0; n < PARTS; n += 2) {
                const bool two = n + 1 < PARTS;
                TILE_LOAD(0, bias + 16 * n, 0);
                TILE_LOAD(1, bias + 16 * n, 0);
                if (two) {
                    TILE_LOAD(2, bias + 16 * n + 16, 0);
                    TILE_LOAD(3, bias + 16 * n + 16, 0);
                }
                PRODUCTS(a + corner * A, A, in_columns * A, weight + n * TILE_VALUES, two)
#if B
                PRODUCTS(b + corner * B, B, in_columns * B, weight + (3 * STEPS(A) * PARTS + n) * TILE_VALUES, two)
#endif
                float *to = sums + n * ACROSS * 16;
                TILE_STORE(0, to);
                TILE_STORE(1, to + 256);
                if (two) {
                    TILE_STORE(2, to + 512);
                    TILE_STORE(3, to + 768);
                }
            }
#ifdef IMAGE
            finish_image(sums, y, x, width, TO);
#else
            finish(sums, y, x, least(width - x, ACROSS), out + out_first, out_columns, out_channels, changes);
#endif
        }
    }
    TILES_END;
}
