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
// Launch (ceil(ceil(width / SIDE) / TILES), ceil(height / SIDE)), work-groups of 1: a work-item is a strip of tiles whose scratch stays in L2.
//
// -D SKIP: only tiles that a change reaches, see change_map.clh; a_changes (the map begins at a_tile), b_changes, color_changes are
// the maps of the inputs, changes that of `out`.
// -D WANTED=n: only tiles no farther than n tiles from one that the map `wanted` marks; see flat_tiles.cl. With IMAGE the others are upsampled alone.
#if !defined(STRIDE) || !defined(SIDE) || !defined(A) || !defined(B) || !defined(OUT) || !defined(USED) || !defined(TILES) || !defined(ROWS) || !defined(BLOCK)
#error "winograd.cl needs -D STRIDE, SIDE, A, B, OUT, USED, TILES, ROWS, BLOCK"
#endif
#if (STRIDE != 1 || SIDE != 4) && ((STRIDE != 1 && STRIDE != 2) || SIDE != 2 || defined(IMAGE) || defined(WANTED))
#error "winograd.cl: SIDE is 4, or 2 without IMAGE and WANTED, or 2 at STRIDE 2"
#endif
#include "common.clh"
#include "winograd.clh"
#ifdef SKIP
#define REACH 1  // a tile reads a pixel beyond each of its sides
#endif
#ifdef WANTED
#define REACH WANTED
#endif
#ifdef REACH
#include "change_map.clh"
#endif
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

#ifdef REACH
// The map's first and last tile (of 4 x 4 pixels) that matter to a tile; the last one may lie beyond the map.
#define NEAR(tile) (most(STEP * (tile) + 3 - 4 * REACH, 0) / 4)
#define FAR(tile) ((STEP * (tile) + STEP - STRIDE - 3 + 4 * REACH) / 4)

// How many tiles of the strip have one in their reach that a or b (which may be 0) marks, and which they are.
static inline int reached(global const uchar *a, global const uchar *b, const int rows, const int columns, const int first,
                          const int last, const int tile_y, int *tiles)
{
    const int top = NEAR(tile_y), bottom = least(FAR(tile_y), rows - 1);
    const int left = NEAR(first), right = least(FAR(first + TILES - 1), columns - 1);
    if (!marked_tiles(a, columns, top, bottom, left, right) && !(b && marked_tiles(b, columns, top, bottom, left, right)))
        return 0;
    uchar column[TILES + 2 * REACH];
    for (int x = left; x <= right; ++x) {
        column[x - left] = 0;
        for (int y = top; y <= bottom; ++y) column[x - left] |= a[y * columns + x] | (b ? b[y * columns + x] : 0);
    }
    int count = 0;
    for (int i = first; i < first + TILES && i <= last; ++i) {
        uchar any = 0;
        for (int x = NEAR(i); x <= least(FAR(i), right); ++x) any |= column[x - left];
        if (any) tiles[count++] = i;
    }
    return count;
}

// The t-th tile that is computed, how many there are, and with those that fill up the last ROWS.
#define TILE(t) tiles[t]
#define COUNT count
#define HELD held
#else
// Beyond the row the last tile stands in: its results are not stored.
#define TILE(t) least(first + (t), last)
#define COUNT least(TILES, last + 1 - first)
#define HELD TILES
#endif

#ifdef SKIP
#define PUT(value, i, buffer) differs |= replace8(value, i, buffer, tolerance)
#else
#define PUT(value, i, buffer) STORE8(value, i, buffer)
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
#ifdef SKIP
              , global const uchar *restrict a_changes, global const uchar *restrict b_changes,
#ifdef IMAGE
              global const uchar *restrict color_changes,
#else
              global uchar *restrict changes,
#endif
              const int a_tile, const float tolerance
#elif defined(WANTED)
              , global const uchar *restrict wanted
#endif
              )
{
    const int first = get_global_id(0) * TILES, tile_y = get_global_id(1), last = (width + SIDE - 1) / SIDE - 1;
    a += a_first;
#ifdef IMAGE
    if (4 * tile_y + 4 <= first_row) return;
#endif
#ifdef REACH
    int tiles[TILES];
    const int tile_columns = (in_columns - 2) / 4;
#if defined(WANTED) && defined(IMAGE)
    const int count = reached(wanted, 0, rows / 4, tile_columns, first, last, tile_y, tiles);
    for (int x = first, t = 0; x <= last && x < first + TILES; ++x) {
        if (t < count && tiles[t] == x) {
            ++t;
            continue;
        }
        const float8 nothing[8] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
        for (int y = most(4 * tile_y, first_row); y < least(4 * tile_y + 4, height); ++y)
            write_pixels(nothing, color, image, y, 4 * x, width, width, rows, columns, top);
    }
#elif defined(WANTED)
    const int count = reached(wanted, 0, (height + 3) / 4, tile_columns, first, last, tile_y, tiles);
#elif defined(IMAGE)
    const int count = reached(a_changes + a_tile, color_changes, rows / 4, tile_columns, first, last, tile_y, tiles);
#else
    global const uchar *others = B ? b_changes : 0;
    const int count = reached(a_changes + a_tile, others, (STRIDE * height + 3) / 4, tile_columns, first, last, tile_y, tiles);
#endif
    if (!count) return;
    int held = count;
    for (; held % ROWS; ++held) tiles[held] = tiles[count - 1];
#endif
    float8 V[GROUP_ROWS(0) * PATCH * TILES * IN8], M[PRODUCTS * TILES * OUT8];
#ifdef GATED
    float8 gates[PRODUCTS * PAIRS];
#endif

    // A few products at a time, those of a few rows: their inputs then stay in L1.
#pragma unroll
    for (int group = 0; group < GROUPS; ++group) {
        for (int t = 0; t < HELD; ++t) {
            const int corner = STEP * (tile_y * in_columns + TILE(t));
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
            fetch(a, A, STEP * (tile_y * in_columns + first + TILES), in_columns, PATCH, k);
#if B
            fetch(b, B, STEP * (tile_y * in_columns + first + TILES), in_columns, PATCH, k);
#endif
#ifndef IMAGE
            fetch(out, out_channels, (SIDE * tile_y + 1) * out_columns + SIDE * first + 1, out_columns, SIDE, k);
#endif
#endif
            for (int block = 0; block < OUT8; block += BLOCK) {
                global const float8 *restrict w = weight + (k * OUT8 + block) * IN;
                for (int t = 0; t < HELD; t += ROWS) {
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
            for (int t = 0; t < HELD; t += 2) {
                const float8 *v = inputs + t * IN8;
                const int other = t + 1 < HELD ? IN8 : 0;
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
    float4 open4[2 * PAIRS * SIDE * SIDE / 4];
    for (int t = 0; t < HELD; t += 2) open_gates(gates + t / 2, PAIRS, gate_bias, open4 + t * SIDE * SIDE / 4);
#endif
    for (int t = 0; t < COUNT; ++t) {
        const int x = SIDE * TILE(t), y = SIDE * tile_y;
#if defined(SKIP) && !defined(IMAGE)
        stored8 differs = 0;
#endif
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
            write_pixels(sums, color, image, y + i, x, width, width, rows, columns, top);
        }
#elif defined(SKIP)
        if (any_bit(differs)) changes[y / 4 * ((out_columns - 2) / 4) + x / 4] = 1;
#endif
    }
}
