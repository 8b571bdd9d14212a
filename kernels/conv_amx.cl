// SPDX-License-Identifier: MIT
// Building block conv on a processor's matrix units, reference stss_ref/conv.py::conv and ::gated: 3 x 3, stride 1 or
// 2, activations and weights in bfloat16, sums in float. Buffers and arguments as in conv.cl, but
//
//  weight  in  (STEPS_OF(A) + STEPS_OF(B) for each row of taps, SIXTEENS, 16, 16, 2) of bfloat16: tiles of 32 inputs x
//              16 outputs; output OUT is the gate
//  bias    in  (16 SIXTEENS)  of the outputs and of the gate
//
// Three taps of a row are 3 C values side by side, so 16 pixels x 32 of these values are one tile, whose rows are
// STRIDE pixels apart. A row's last step reads further values, whose weights are 0. An output's sum depends only on its
// own inputs, so tiles may be left out.
// Build -D STORED=BFLOAT16 -D A -D B -D OUT (multiples of 8; A may be 4) -D STRIDE, optionally -D EMULATE (amx.clh) -D
// GATED -D RELU -D MARK (change_map.clh).
// -D IMAGE, where OUT is 24: the outputs go through outc and become the image; color and the arguments after it as in
// winograd_image.cl, but outc_weight (2, 16, 16, 2) are tiles like `weight`: bfloat16, and the remainders of that
// rounding. Launch (any number of work-items), work-groups of 1, over tiles of 32 x 4 pixels (tile_list.clh).
#if !defined(A) || !defined(B) || !defined(OUT) || !defined(STRIDE)
#error "conv_amx.cl needs -D A, B, OUT, STRIDE"
#endif
#include "common.clh"
#include "tile_list.clh"
#include "layer.clh"
#include "amx.clh"
#ifdef IMAGE
#include "decoder.clh"
#endif

#ifdef GATED
#define SIXTEENS (OUT / 16 + 1)
#else
#define SIXTEENS ((OUT + 15) / 16)
#endif
#define STEPS_OF(channels) ((3 * (channels) + 31) / 32)
#define ACROSS 32
#define TILE_VALUES 512  // bfloat16 of a tile of weights

// Values of a step. A row of a tile that lies in two cache lines takes as long to load as four other rows. With 24
// channels, rows of 24 values, a tap each, lie so less often than rows of 32, and take no more steps.
#define IN_STEP(channels) ((channels) == 24 ? 24 : 32)
#define LEAST_STEP ((A == 24 && (B == 24 || B == 0)) ? 24 : 32)

#if STORED != BFLOAT16
#error "conv_amx.cl needs -D STORED=BFLOAT16"
#endif

// Prefetches memory line by line, to be read or, if `writes` is 1, written.
#ifdef EMULATE
#define PREFETCH(from, bytes, writes)
#else
#define PREFETCH(from, bytes, writes)                            \
    _Pragma("unroll") for (int i = 0; i < (int)(bytes); i += 64) \
        __builtin_prefetch((const void *)((size_t)(from) + i), writes, 2)
#endif

// Prefetches one of 12 parts of a tile's input: half a row of pixels, or at stride 2 one of its nine rows.
static inline void prefetch_rows(global const stored *from, const int channels, const int line, const int part)
{
    from += STRIDE == 1 ? part / 2 * line + part % 2 * (ACROSS / 2) * channels : least(part, 8) * line;
    PREFETCH(from, (STRIDE == 1 ? ACROSS / 2 : 2 * ACROSS) * channels * sizeof(stored), 0);
}

// Adds the products of one input of 2 x 16 pixels with one or two parts of the outputs to tiles 0 .. 3. Meanwhile it
// prefetches parts of the next tile's input, and FINISH works on other rows. A macro, since tiles have numbers, not
// addresses.
#define ADD_PRODUCTS(from, channels, line, weights, two, next, slot)                                         \
    for (int tap = 0; tap < 3; ++tap) {                                                                      \
        if (n == 0) prefetch_rows(next, channels, line, 3 * row + tap);                                      \
        for (int step = 0; step < STEPS_OF(channels); ++step) {                                              \
            global const stored *pixels = (from) + tap * (line) + IN_STEP(channels) * step;                  \
            global const stored *w = (weights) + (tap * STEPS_OF(channels) + step) * SIXTEENS * TILE_VALUES; \
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
        }                                                                                                    \
        FINISH((slot) + tap);                                                                                \
    }

// ReLU, rounding.
static inline ushort16 rounded(const float16 value)
{
    const ushort16 bits = narrow16(value);
#ifdef RELU
    return bits & as_ushort16(as_short16(bits) > (short16)(0));
#else
    return bits;
#endif
}

#ifdef IMAGE
// ReLU and rounding of a row's pixels: sums in the order part, pixel, output become rows of tiles.
static inline void features_of(const float *sums, uint16 *features)
{
    for (int p = 0; p < ACROSS; ++p) {
        const ushort16 first = rounded(*(const float16 *)(sums + p * 16)),
                       second = rounded(*(const float16 *)(sums + (ACROSS + p) * 16));
        features[p] = (uint16)(as_uint8(first), as_uint8(second));
    }
}

// Writes two rows of the image for `pixels` pixels from (y, x) on: the upsampled frame plus outc's sums.
static inline void finish_image(const float *residuals, const int y, const int x, const int pixels, const int width,
                                global const float4 *color, global float *image, const int rows, const int columns,
                                const int top)
{
    float between[8 * (ACROSS + 2)] __attribute__((aligned(64))), lines[2][6 * ACROSS + 2] __attribute__((aligned(64)));
    columns_between_rows(color, y, x, rows, columns, ACROSS, between);
    for (int p = 0; p < ACROSS; ++p) {
        const float16 both = between_three(between + 8 * p) + *(const float16 *)(residuals + 16 * p);
        *(float8_unaligned *)(lines[0] + 6 * p) = both.lo;
        *(float8_unaligned *)(lines[1] + 6 * p) = both.hi;
    }
    global float *to = image + (2 * (top + y) * (2 * width) + 2 * x) * 3;
    copy_floats(lines[0], 6 * pixels, to);
    copy_floats(lines[1], 6 * pixels, to + 6 * width);
}

// Prefetches one of 12 parts of the next tile's colours: half of one of six rows.
static inline void prefetch_colors(global const float4 *from, const int columns, const int part)
{
    PREFETCH(from + (part / 2 - 1) * columns + part % 2 * (ACROSS / 2), (ACROSS / 2 + 1) * sizeof(float4), 0);
}

// Prefetches a third of both rows of the image, `line` floats apart, that begin at `to`.
static inline void prefetch_image(global const float *to, const int line, const int third)
{
    to += third * 2 * ACROSS;
    PREFETCH(to, 2 * ACROSS * sizeof(float), 1);
    PREFETCH(to + line, 2 * ACROSS * sizeof(float), 1);
}

#define FINISH(slot)                                                                                          \
    prefetch_colors(color + 4 * TILE_ROW(ahead) * shown.columns + ACROSS * TILE_COLUMN(ahead), shown.columns, \
                    3 * row + (slot));                                                                        \
    prefetch_image(image + (2 * (shown.top + y) * (2 * layer.width) + 2 * x) * 3, 6 * layer.width, slot)
#else
#define SLOTS ((SIXTEENS + 1) / 2 * (B ? 6 : 3))  // one for each row of taps of all products for a row of outputs
#define IN_SLOT ((ACROSS + SLOTS - 1) / SLOTS)  // pixels to finish in each slot

// A row of outputs with complete sums, in the order part, pixel, output.
typedef struct {
    const float *sums;
    int y, x, pixels;
} Row;

// Stores the pixels `first` .. `end` - 1 of a row.
static inline __attribute__((always_inline)) void store_pixels(const Row row, const int first, const int end,
                                                               const float *open, global stored *out,
                                                               const int out_columns, const int out_channels,
                                                               global uchar *changes)
{
    global stored *to = out + ((row.y + 1) * out_columns + row.x + 1) * out_channels;
    for (int p = first; p < end; ++p) {
        BEGIN_PIXEL;
#pragma unroll
        for (int c = 0; c < OUT / 8; c += 2) {
            float16 value = *(const float16 *)(row.sums + (c / 2 * ACROSS + p) * 16);
#ifdef GATED
            value *= open[p];
#endif
            const ushort16 bits = rounded(value);
            if (c + 1 < OUT / 8)
                PUT_STORED16(bits, c, to + p * out_channels);
            else
                PUT_STORED8(bits.lo, c, to + p * out_channels);
        }
        END_PIXEL(row.y * (out_columns - 2) + row.x + p);
    }
}

// Stores the slot's pixels of a row with gate, ReLU and rounding; slot 0 fills `open`.
static inline void finish(const Row row, const int slot, float *open, global stored *out, const int out_columns,
                          const int out_channels, global uchar *changes)
{
#ifdef GATED
    if (slot == 0 && row.pixels) {
        const float *sums = row.sums + OUT / 16 * ACROSS * 16 + OUT % 16;
#pragma unroll
        for (int p = 0; p < ACROSS; p += 8, sums += 128)
            *(float8 *)(open + p) =
                sigmoid8((float8)(sums[0], sums[16], sums[32], sums[48], sums[64], sums[80], sums[96], sums[112]));
    }
#endif
    const int first = slot * IN_SLOT, end = least(first + IN_SLOT, row.pixels);
    // Two loops, since a test at each store takes a tenth of the kernel's time.
    if (MARKS(changes))
        store_pixels(row, first, end, open, out, out_columns, out_channels, changes);
    else
        store_pixels(row, first, end, open, out, out_columns, out_channels, 0);
}

// First prefetches the memory of the slot's pixels of this row, since a store waits for its line.
#define FINISH(slot)                                                                                                \
    PREFETCH(out + layer.out_first + ((y + 1) * layer.out_columns + x + 1 + (slot) * IN_SLOT) * layer.out_channels, \
             IN_SLOT * OUT * sizeof(stored), 1);                                                                    \
    finish(wait, slot, open, out + layer.out_first, layer.out_columns, layer.out_channels, changes)
#endif

kernel __attribute__((reqd_work_group_size(1, 1, 1))) void conv_amx(
    global const stored *restrict a, global const stored *restrict b, global const stored *restrict weight,
    global const stored *restrict gate_weight, global const float *restrict bias, const float gate_bias,
    const Layer layer, global const uint *restrict tiles, global const int *restrict count,
#ifdef IMAGE
    global const float4 *restrict color, global const stored *restrict outc_weight,
    global const float *restrict outc_bias, global float *restrict image, const Image shown)
#else
    global stored *restrict out, global uchar *restrict changes)
#endif
{
    TILES_BEGIN(LEAST_STEP);
#ifdef IMAGE
    float made[SIXTEENS * ACROSS * 16] __attribute__((aligned(64)));
#else
    float sums[2][SIXTEENS * ACROSS * 16] __attribute__((aligned(64))), open[ACROSS] __attribute__((aligned(32)));
    Row wait = {sums[0], 0, 0, 0};
#endif
    a += layer.a_first;
    const int2 part = part_of_list(count[0], 1);
    for (int t = part.x; t < part.y; ++t) {
        const uint ahead = tiles[least(t + 1, part.y - 1)];
        const int next = STRIDE * (4 * TILE_ROW(ahead) * layer.in_columns + ACROSS * TILE_COLUMN(ahead));
        const int x = ACROSS * TILE_COLUMN(tiles[t]);
        for (int row = 0; row < 4; ++row) {
            const int y = 4 * TILE_ROW(tiles[t]) + row, corner = STRIDE * (y * layer.in_columns + x);
            if (y >= layer.height) break;
#ifndef IMAGE
            float *made = wait.sums == sums[0] ? sums[1] : sums[0];
#endif
            for (int n = 0; n < SIXTEENS; n += 2) {
                const bool two = n + 1 < SIXTEENS;
                TILE_LOAD(0, bias + 16 * n, 0);
                TILE_LOAD(1, bias + 16 * n, 0);
                if (two) {
                    TILE_LOAD(2, bias + 16 * n + 16, 0);
                    TILE_LOAD(3, bias + 16 * n + 16, 0);
                }
                ADD_PRODUCTS(a + corner * A, A, layer.in_columns * A, weight + n * TILE_VALUES, two, a + next * A,
                             n / 2 * (B ? 6 : 3))
#if B
                ADD_PRODUCTS(b + corner * B, B, layer.in_columns * B,
                             weight + (3 * STEPS_OF(A) * SIXTEENS + n) * TILE_VALUES, two, b + next * B, n / 2 * 6 + 3)
#endif
                float *to = made + n * ACROSS * 16;
                TILE_STORE(0, to);
                TILE_STORE(1, to + 256);
                if (two) {
                    TILE_STORE(2, to + 512);
                    TILE_STORE(3, to + 768);
                }
            }
#ifdef IMAGE
            if (y < shown.first_row) continue;
            uint16 features[ACROSS] __attribute__((aligned(64)));
            features_of(made, features);
            TILE_LOAD(0, outc_bias, 0);
            TILE_LOAD(1, outc_bias, 0);
            TILE_LOAD_OWN(4, features);
            TILE_LOAD_OWN(5, features + 16);
            TILE_LOAD(6, outc_weight, 64);
            TILE_LOAD(7, outc_weight + TILE_VALUES, 64);
            TILE_MULTIPLY(0, 4, 6);
            TILE_MULTIPLY(1, 5, 6);
            TILE_MULTIPLY(0, 4, 7);
            TILE_MULTIPLY(1, 5, 7);
            TILE_STORE(0, made);
            TILE_STORE(1, made + 256);
            finish_image(made, y, x, least(layer.width - x, ACROSS), layer.width, color, image, shown.rows,
                         shown.columns, shown.top);
#else
            wait = (Row){made, y, x, least(layer.width - x, ACROSS)};
#endif
        }
    }
#ifndef IMAGE
    for (int slot = 0; slot < SLOTS; ++slot)
        finish(wait, slot, open, out + layer.out_first, layer.out_columns, layer.out_channels, changes);
#endif
    TILES_END;
}
