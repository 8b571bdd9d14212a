// Building block conv, the fast variant of conv.cl for 3 x 3: at stride 1 Winograd F(4x4, 3x3) on the points 0, +-5/8, +-3/2, infinity,
// or F(2x2, 3x3) on 0, +-1, infinity; their constants are exact in float32 (docs/decisions/0011-winograd.md, 0021). At stride 2 see winograd.clh.
//
//  buffer       dir  shape                       content
//  a            in   padded, (A)                 first input, see common.clh; begins at element a_first, a multiple of 8
//  b            in   padded, (B)                 second input, concatenated behind it; not read where B = 0
//  weight       in   (PRODUCTS, LANES / (VECTOR BLOCK), A + B, VECTOR BLOCK)  G w G^T, transformed in float64 by stss_cl/network/pack_weights.py
//  gate_weight  in   (PRODUCTS, A + B)           of the one gate channel; read if GATED, but where a lane behind the outputs has it
//  bias         in   (OUT)
//  out          out  padded, (out_channels)      channels out_first .. out_first + OUT - 1 of it
//
// Build -D STRIDE (1 or 2) -D SIDE (4 or 2: pixels of an output tile's side; 2 at stride 2) -D A -D B -D OUT (multiples of 8) -D USED (the inputs behind are zeros) -D TILES (per
// work-item) -D VECTOR (8 or 16 lanes; LANES is OUT rounded up to it; at 16 TILES is even)
// -D ROWS (tiles held at once, divides TILES) -D BLOCK (vectors of outputs held at once, divides LANES / VECTOR), optionally
// -D GATED -D RELU -D HALF -D PREFETCH -D IMAGE (SIDE 4: the decoder's output in place of `out`, see decoder.clh; rows `first_row` .. height - 1
// are written, rows and columns are those of `color`; row 0 is the frame's row `top`).
// `tiles`, `count`: the tiles of the output, SIDE x SIDE pixels each, that are computed, see tile_list.clh.
// Launch (any number of work-items), work-groups of 1: a work-item takes a strip of TILES after the other, whose scratch stays in L2.
//
// -D PAIRED, in place of zeros behind 24 outputs: the last 8 of them take two inputs at once, each lane one of them. The weight of two inputs is then
// the other outputs' of one, theirs of the other, and both of each of the last 8.
//
// -D MARK: a value is compared with the one that is stored, and `changes`, the output's map, marked where bits came to differ (change_map.clh).
#if !defined(STRIDE) || !defined(SIDE) || !defined(A) || !defined(B) || !defined(OUT) || !defined(USED) || !defined(TILES) || !defined(ROWS) || !defined(BLOCK) || !defined(VECTOR)
#error "winograd.cl needs -D STRIDE, SIDE, A, B, OUT, USED, TILES, ROWS, BLOCK, VECTOR"
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
#define LANES ((OUT + VECTOR - 1) / VECTOR * VECTOR)
#define BLOCKS (LANES / VECTOR)
// The gate's sums have a tile in each lane.
#define GATES ((TILES + VECTOR - 1) / VECTOR * VECTOR)

#ifdef PAIRED
#define WEIGHTS(k, block) ((k) * (2 * BLOCK - 1) * IN / 2)
#define LAST8(sum) (sum).even + (sum).odd
#else
#define WEIGHTS(k, block) (((k) * BLOCKS + (block)) * IN)
#define LAST8(sum) HALF_OF(sum, 0)
#endif
#if defined(GATED) && OUT % VECTOR
#define GATE_LANE
#endif
#define OPEN(t, place) ((const float *)open)[((t) / VECTOR * SIDE * SIDE + (place)) * VECTOR + (t) % VECTOR]

// Where the n-th of output_rows(parity) lies from the first; whether it lies in the frame.
#define AT(n) ((n) / SIDE * 2 * line + (n) % SIDE * OUT_CHANNELS)
#define INSIDE(n) (y + parity + (n) / SIDE * 2 < height && x + (n) % SIDE < width)
#define WRITE(one, where) { _Pragma("unroll") for (int n = 0; n < PARITY_ROWS * SIDE; ++n) if (where) { one; } }

// Where in the input a tile's patch begins; the last strip is filled up with its last tile.
ALWAYS int corner(global const uint *strip, const int t, const int held, const int in_columns)
{
    const uint tile = strip[least(t, held - 1)];
    return STEP * (TILE_ROW(tile) * in_columns + TILE_COLUMN(tile));
}

// The group's rows of every tile of a strip. What does not fill a vector, a tile's last eight, goes together with the next tile's.
ALWAYS void inputs_of(const int group, global const stored *buffer, const int channels, global const uint *strip, const int held,
                             const int in_columns, float8 *to)
{
    const int eights = channels / 8, line = in_columns * channels;
    for (int t = 0; t < TILES; ++t) {
        global const stored *source = buffer + corner(strip, t, held, in_columns) * channels;
        float8 *tile = to + t * IN8;
#pragma nounroll
        for (int c = 0; c + EIGHTS <= eights; c += EIGHTS)
            input_rows(group, source + 8 * c, source + 8 * c, line, channels, tile + c, tile + c, TILES * IN8, 1);
    }
    if (eights % EIGHTS)
        for (int t = 0; t < TILES; t += 2) {
            global const stored *last = buffer + channels - 8;
            input_rows(group, last + corner(strip, t, held, in_columns) * channels, last + corner(strip, t + 1, held, in_columns) * channels,
                       line, channels, to + t * IN8 + eights - 1, to + (t + 1) * IN8 + eights - 1, TILES * IN8, 0);
        }
}

#ifdef PREFETCH
// The k-th of PRODUCTS parts of `rows` rows (PATCH of STEP pixels a tile, or SIDE of SIDE) of a strip of tiles: line by line, for OpenCL's own
// prefetch() does nothing on PoCL. PRODUCTS is a multiple of the rows, or one more: then the last part is a row too far, which is read soon.
static inline void fetch(global const stored *buffer, const int channels, const int pixel, const int columns, const int rows, const int k)
{
    const int line = 64 / sizeof(stored), lines = (rows == PATCH ? STEP : SIDE) * TILES * channels / line;
    const int parts = PRODUCTS / rows, part = (lines + parts - 1) / parts;  // known when it is compiled
    global const stored *from = buffer + (pixel + k / parts * columns) * channels + k % parts * part * line;
#pragma unroll
    for (int i = 0; i < part; ++i) __builtin_prefetch((const void *)(size_t)(from + i * line), 0, 2);
}
#endif

kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void winograd(global const stored *restrict a, global const stored *restrict b, global const vec *restrict weight,
              global const float8 *restrict gate_weight, global const float8 *restrict bias, const float gate_bias,
              global stored *restrict out, const int a_first, const int height, const int width, const int in_columns, const int out_columns,
              const int out_first
#ifdef IMAGE
              , global const float4 *restrict color, global const float16 *restrict outc_weight,
              global const float16 *restrict outc_bias, global float *restrict image, const int rows, const int columns,
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
    vec gates[PRODUCTS * GATES / VECTOR], open[SIDE * SIDE * GATES / VECTOR];
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
                for (int block = 0; block < BLOCKS; block += BLOCK) {
                    global const vec *restrict w = weight + WEIGHTS(k, block);
                    for (int t = 0; t < TILES; t += ROWS) {
                        const float *v = (const float *)(inputs + t * IN8);
                        vec sum[ROWS * BLOCK];
#pragma unroll
                        for (int i = 0; i < ROWS * BLOCK; ++i) sum[i] = 0.0f;
#ifdef PAIRED
                        for (int c = 0; c < USED; c += 2) {
                            global const vec *restrict wc = w + c / 2 * (2 * BLOCK - 1);
                            vec one[BLOCK - 1], two[BLOCK];
#pragma unroll
                            for (int j = 0; j < BLOCK - 1; ++j) one[j] = wc[j];
#pragma unroll
                            for (int j = 0; j < BLOCK; ++j) two[j] = wc[BLOCK - 1 + j];
#pragma unroll
                            for (int r = 0; r < ROWS; ++r) {
                                const vec value = (vec)(v[r * IN + c]), next = (vec)(v[r * IN + c + 1]);
                                const float2 pair = *(const float2 *)(v + r * IN + c);
#pragma unroll
                                for (int j = 0; j < BLOCK - 1; ++j) sum[r * BLOCK + j] += value * one[j];
#pragma unroll
                                for (int j = 0; j < BLOCK - 1; ++j) sum[r * BLOCK + j] += next * two[j];
                                sum[r * BLOCK + BLOCK - 1] += (vec)(pair, pair, pair, pair, pair, pair, pair, pair) * two[BLOCK - 1];
                            }
                        }
#else
                        for (int c = 0; c < USED; ++c) {
                            vec wc[BLOCK];
#pragma unroll
                            for (int j = 0; j < BLOCK; ++j) wc[j] = w[c * BLOCK + j];
#pragma unroll
                            for (int r = 0; r < ROWS; ++r) {
                                const vec value = (vec)(v[r * IN + c]);
#pragma unroll
                                for (int j = 0; j < BLOCK; ++j) sum[r * BLOCK + j] += value * wc[j];
                            }
                        }
#endif
#pragma unroll
                        for (int i = 0; i < ROWS * BLOCK; ++i) {
                            const int c = EIGHTS * (block + i % BLOCK);
                            float8 *to = M + (k * TILES + t + i / BLOCK) * OUT8 + c;
                            if (c + EIGHTS <= OUT8)
                                *(vec_at_eight *)to = sum[i];
                            else
                                *to = LAST8(sum[i]);
                        }
#ifdef GATE_LANE
                        if (block + BLOCK == BLOCKS)
#pragma unroll
                            for (int r = 0; r < ROWS; ++r) ((float *)gates)[k * GATES + t + r] = sum[(r + 1) * BLOCK - 1].s8;
#endif
                    }
                }
#if defined(GATED) && !defined(GATE_LANE)
                for (int t = 0; t < TILES; t += 4) {
                    float8 sums[4];
#pragma unroll
                    for (int i = 0; i < 4; ++i) {
                        const float8 *v = inputs + least(t + i, TILES - 1) * IN8;
                        sums[i] = 0.0f;
#pragma unroll
                        for (int c = 0; c < IN8; ++c) sums[i] += v[c] * gate_weight[k * IN8 + c];
                    }
                    const float8 halves = sums4(sums);
                    ((float4 *)gates)[(k * GATES + t) / 4] = halves.lo + halves.hi;
                }
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
                    const vec shift = BOTH(bias[one % OUT8], bias[two % OUT8]);
                    vec values[PARITY_ROWS * SIDE];
                    output_rows(parity, M + t * OUT8 + one, M + t * OUT8 + two, TILES * OUT8, !LEFT_OVER(OUT8, v), values);
#pragma unroll
                    for (int n = 0; n < PARITY_ROWS * SIDE; ++n) {
                        values[n] += shift;
#ifdef GATED
                        values[n] *= BOTH((float8)(OPEN(t + one / OUT8, PLACE(parity, n))), (float8)(OPEN(t + two / OUT8, PLACE(parity, n))));
#endif
                    }
#ifdef RELU
#pragma unroll
                    for (int n = 0; n < PARITY_ROWS * SIDE; ++n) values[n] = relu_vec(values[n]);
#endif
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
                        if (LEFT_OVER(OUT8, v)) {
                            if (whole)
                                WRITE(PUT(HALF_OF(values[n], h), 0, to + AT(n)), 1)
                            else
                                WRITE(PUT(HALF_OF(values[n], h), 0, to + AT(n)), INSIDE(n))
                        } else {
                            if (whole)
                                WRITE(PUT_VEC(values[n], to + AT(n)), 1)
                            else
                                WRITE(PUT_VEC(values[n], to + AT(n)), INSIDE(n))
                        }
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
