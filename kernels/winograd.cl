// Building block conv, the fast variant of conv.cl for 3 x 3, stride 1: Winograd F(4x4, 3x3) on the points 0, +-5/8, +-3/2, infinity,
// whose constants are exact in float32 (docs/decisions/0011-winograd.md).
//
//  buffer       dir  shape                       content
//  a            in   padded, (A)                 first input, see common.clh; begins at element a_first, a multiple of 8
//  b            in   padded, (B)                 second input, concatenated behind it; not read where B = 0
//  weight       in   (36, A + B, OUT)            G w G^T, transformed in float64 by stss_cl/packing.py
//  gate_weight  in   (36, A + B)                 of the one gate channel; read if GATED
//  bias         in   (OUT)
//  out          out  padded, (out_channels)      channels out_first .. out_first + OUT - 1 of it
//
// Build -D A -D B -D OUT (multiples of 8) -D USED (the inputs behind are zeros) -D TILES (per work-item) -D ROWS (tiles held at once, divides TILES) -D BLOCK (float8 of
// outputs held at once, divides OUT / 8), optionally -D GATED -D RELU -D HALF -D IMAGE (the decoder's output in place of `out`, see
// decoder.clh; rows `from` .. height - 1 are written, rows and columns are those of `color`; row 0 is the frame's row `top`).
// Launch (ceil(ceil(width / 4) / TILES), ceil(height / 4)), work-groups of 1: a work-item is a strip of tiles whose scratch stays in L2.
//
// -D SKIP: only tiles that a change reaches, see changes.clh; a_changes (the map begins at a_tile), b_changes, color_changes are
// the maps of the inputs, changes that of `out`.
// -D WANTED=n: only tiles no farther than n tiles from one that the map `wanted` marks; see plain.cl. With IMAGE the others are upsampled alone.
#if !defined(A) || !defined(B) || !defined(OUT) || !defined(USED) || !defined(TILES) || !defined(ROWS) || !defined(BLOCK)
#error "winograd.cl needs -D A, B, OUT, USED, TILES, ROWS, BLOCK"
#endif
#ifdef PYOPENCL_USING_OCLGRIND  // defined by PyOpenCL; Oclgrind 21.10 ends the process at __builtin_prefetch
#undef PREFETCH
#endif
#include "common.clh"
#ifdef SKIP
#define REACH 1  // a tile reads its neighbours
#endif
#ifdef WANTED
#define REACH WANTED
#endif
#ifdef REACH
#include "changes.clh"
#endif
#ifdef IMAGE
#include "decoder.clh"
#endif

#define IN (A + B)
#define IN8 (IN / 8)
#define OUT8 (OUT / 8)

// p = 5/8, q = 3/2: their powers and sums, all exact.
#define P 0.625f
#define Q 1.5f
#define PP 0.390625f
#define QQ 2.25f
#define PPP 0.244140625f
#define QQQ 3.375f
#define PPQQ 0.87890625f
#define PP_QQ 2.640625f

// One row or column of B^T d: six values in, six out, `step` apart.
static inline void input_transform(const float8 d0, const float8 d1, const float8 d2, const float8 d3, const float8 d4,
                                   const float8 d5, float8 *out, const int step)
{
    const float8 even_p = d4 - QQ * d2, odd_p = d3 - QQ * d1, even_q = d4 - PP * d2, odd_q = d3 - PP * d1;
    out[0] = PPQQ * d0 + (d4 - PP_QQ * d2);
    out[step] = even_p + P * odd_p;
    out[2 * step] = even_p - P * odd_p;
    out[3 * step] = even_q + Q * odd_q;
    out[4 * step] = even_q - Q * odd_q;
    out[5 * step] = PPQQ * d1 + (d5 - PP_QQ * d3);
}

// One row or column of A^T m: six values in, four out.
static inline void output_transform(const float8 m0, const float8 m1, const float8 m2, const float8 m3, const float8 m4,
                                    const float8 m5, float8 *out, const int step)
{
    const float8 even_p = m1 + m2, odd_p = m1 - m2, even_q = m3 + m4, odd_q = m3 - m4;
    out[0] = m0 + even_p + even_q;
    out[step] = P * odd_p + Q * odd_q;
    out[2 * step] = PP * even_p + QQ * even_q;
    out[3 * step] = PPP * odd_p + (QQQ * odd_q + m5);
}

static inline void output_tile(const float8 *m, const int step, float8 *tile)
{
    float8 rows[24];
#pragma unroll
    for (int i = 0; i < 6; ++i, m += 6 * step)
        output_transform(m[0], m[step], m[2 * step], m[3 * step], m[4 * step], m[5 * step], rows + 4 * i, 1);
#pragma unroll
    for (int i = 0; i < 4; ++i)
        output_transform(rows[i], rows[4 + i], rows[8 + i], rows[12 + i], rows[16 + i], rows[20 + i], tile + i, 4);
}

// Eight channels of one 6 x 6 patch into V[36], `step` apart.
static inline void input_tile(global const stored *source, const int pixel, const int columns, const int channels8,
                              const int c, float8 *V, const int step)
{
    float8 rows[36];
#pragma unroll
    for (int i = 0; i < 6; ++i) {
        const int at = (pixel + i * columns) * channels8 + c;
        input_transform(LOAD8(source, at), LOAD8(source, at + channels8), LOAD8(source, at + 2 * channels8),
                        LOAD8(source, at + 3 * channels8), LOAD8(source, at + 4 * channels8), LOAD8(source, at + 5 * channels8),
                        rows + 6 * i, 1);
    }
#pragma unroll
    for (int i = 0; i < 6; ++i)
        input_transform(rows[i], rows[6 + i], rows[12 + i], rows[18 + i], rows[24 + i], rows[30 + i], V + i * step, 6 * step);
}

#ifdef PREFETCH
// The k-th of 36 parts of `rows` rows of a strip of tiles: line by line, for OpenCL's own prefetch() does nothing on PoCL. Six parts
// are a row (or four rows are 36 parts of 9 to a row), so that no division is left when the loop runs.
static inline void fetch(global const stored *buffer, const int channels, const int pixel, const int columns, const int rows, const int k)
{
    const int line = 64 / sizeof(stored), lines = 4 * TILES * channels / line, parts = 36 / rows, part = (lines + parts - 1) / parts;
    global const stored *from = buffer + (pixel + k / parts * columns) * channels + k % parts * part * line;
#pragma unroll
    for (int i = 0; i < part; ++i) __builtin_prefetch((const void *)(size_t)(from + i * line));
}
#endif

#ifdef REACH
// How many tiles of the strip are marked in a or b (which may be 0), or no farther than REACH from one that is, and which they are.
static inline int reached(global const uchar *a, global const uchar *b, const int rows, const int columns, const int first,
                          const int last, const int tile_y, int *tiles)
{
    const int top = max(tile_y - REACH, 0), bottom = min(tile_y + REACH, rows - 1);
    const int left = max(first - REACH, 0), right = min(first + TILES - 1 + REACH, columns - 1);
    if (!marked_tiles(a, columns, top, bottom, left, right) && !(b && marked_tiles(b, columns, top, bottom, left, right)))
        return 0;
    uchar column[TILES + 2 * REACH];
    for (int i = 0; i < TILES + 2 * REACH; ++i) {
        const int x = min(max(first - REACH + i, left), right);
        column[i] = 0;
        for (int y = top; y <= bottom; ++y) column[i] |= a[y * columns + x] | (b ? b[y * columns + x] : 0);
    }
    int count = 0;
    for (int i = 0; i < TILES && first + i <= last; ++i) {
        uchar any = 0;
        for (int j = i; j <= i + 2 * REACH; ++j) any |= column[j];
        if (any) tiles[count++] = first + i;
    }
    return count;
}

// The t-th tile that is computed, how many there are, and with those that fill up the last ROWS.
#define TILE(t) tiles[t]
#define COUNT count
#define HELD held
#else
// Beyond the row the last tile stands in: its results are not stored.
#define TILE(t) min(first + (t), last)
#define COUNT min(TILES, last + 1 - first)
#define HELD TILES
#endif

kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void winograd(global const stored *restrict a, global const stored *restrict b, global const float8 *restrict weight,
              global const float8 *restrict gate_weight, global const float8 *restrict bias, const float gate_bias,
              global stored *restrict out, const int a_first, const int height, const int width, const int in_columns, const int out_columns,
              const int out_channels, const int out_first
#ifdef IMAGE
              , global const float4 *restrict color, global const float8 *restrict outc_weight,
              global const float8 *restrict outc_bias, global float *restrict image, const int rows, const int columns,
              const int from, const int top
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
    const int first = get_global_id(0) * TILES, tile_y = get_global_id(1), last = (width + 3) / 4 - 1;
    a += a_first;
#ifdef IMAGE
    if (4 * tile_y + 4 <= from) return;
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
        for (int y = max(4 * tile_y, from); y < min(4 * tile_y + 4, height); ++y)
            write_pixels(nothing, color, image, y, 4 * x, width, width, rows, columns, top);
    }
#elif defined(WANTED)
    const int count = reached(wanted, 0, (height + 3) / 4, tile_columns, first, last, tile_y, tiles);
#elif defined(IMAGE)
    const int count = reached(a_changes + a_tile, color_changes, rows / 4, tile_columns, first, last, tile_y, tiles);
#else
    global const uchar *others = B ? b_changes : 0;
    const int count = reached(a_changes + a_tile, others, (height + 3) / 4, tile_columns, first, last, tile_y, tiles);
#endif
    if (!count) return;
    int held = count;
    for (; held % ROWS; ++held) tiles[held] = tiles[count - 1];
#endif
    float8 V[36 * TILES * IN8], M[36 * TILES * OUT8];
#ifdef GATED
    float8 gates[36 * TILES];
#endif

    for (int t = 0; t < HELD; ++t) {
        const int corner = 4 * tile_y * in_columns + 4 * TILE(t);
        for (int c = 0; c < A / 8; ++c) input_tile(a, corner, in_columns, A / 8, c, V + t * IN8 + c, TILES * IN8);
#if B
        for (int c = 0; c < B / 8; ++c) input_tile(b, corner, in_columns, B / 8, c, V + t * IN8 + A / 8 + c, TILES * IN8);
#endif
    }

    for (int k = 0; k < 36; ++k) {
#ifdef PREFETCH
        // While this strip multiplies, the next one's input and this one's output come into the cache.
        fetch(a, A, 4 * tile_y * in_columns + 4 * (first + TILES), in_columns, 6, k);
#if B
        fetch(b, B, 4 * tile_y * in_columns + 4 * (first + TILES), in_columns, 6, k);
#endif
#ifndef IMAGE
        fetch(out, out_channels, (4 * tile_y + 1) * out_columns + 4 * first + 1, out_columns, 4, k);
#endif
#endif
        for (int block = 0; block < OUT8; block += BLOCK) {
            global const float8 *restrict w = weight + k * IN * OUT8 + block;
            for (int t = 0; t < HELD; t += ROWS) {
                const float *v = (const float *)(V + (k * TILES + t) * IN8);
                float8 sum[ROWS * BLOCK];
#pragma unroll
                for (int i = 0; i < ROWS * BLOCK; ++i) sum[i] = 0.0f;
                for (int c = 0; c < USED; ++c) {
                    float8 wc[BLOCK];
#pragma unroll
                    for (int j = 0; j < BLOCK; ++j) wc[j] = w[c * OUT8 + j];
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
    }

#ifdef GATED
    // The output transform is linear: it may run on the eight lanes' partial sums, which are added only at its end.
    for (int k = 0; k < 36; ++k)
        for (int t = 0; t < HELD; ++t) {
            float8 gate = 0.0f;
#pragma unroll
            for (int c = 0; c < IN8; ++c) gate += V[(k * TILES + t) * IN8 + c] * gate_weight[k * IN8 + c];
            gates[k * TILES + t] = gate;
        }
#endif

    for (int t = 0; t < COUNT; ++t) {
        const int x = 4 * TILE(t), y = 4 * tile_y;
#if defined(SKIP) && !defined(IMAGE)
        stored8 differs = 0;
#endif
#ifdef GATED
        float8 partial[16], open8[2];
        float4 *open4 = (float4 *)open8;
        const float *open = (const float *)open8;
        output_tile(gates + t, TILES, partial);
#pragma unroll
        for (int i = 0; i < 4; ++i) open4[i] = sums4(partial + 4 * i) + gate_bias;
        open8[0] = sigmoid8(open8[0]);
        open8[1] = sigmoid8(open8[1]);
#endif
#ifdef IMAGE
        float8 features[16 * OUT8];
#endif
        for (int c = 0; c < OUT8; ++c) {
            float8 tile[16];
            output_tile(M + t * OUT8 + c, TILES * OUT8, tile);
            for (int i = 0; i < 4 && y + i < height; ++i) {
                const int pixel = ((y + i + 1) * out_columns + x + 1) * (out_channels / 8) + out_first / 8 + c;
#pragma unroll
                for (int j = 0; j < 4; ++j) {
                    float8 value = tile[4 * i + j] + bias[c];
#ifdef GATED
                    value *= open[4 * i + j];
#endif
#ifdef RELU
                    value = relu8(value);
#endif
#ifdef IMAGE
                    features[(4 * i + j) * OUT8 + c] = value;
#elif defined(SKIP)
                    if (x + j < width) differs |= replace8(value, pixel + j * (out_channels / 8), out, tolerance);
#else
                    if (x + j < width) STORE8(value, pixel + j * (out_channels / 8), out);
#endif
                }
            }
        }
#ifdef IMAGE
        for (int i = max(from - y, 0); i < 4 && y + i < height; ++i) {
            float8 sums[8];
            residual((const float *)(features + 4 * i * OUT8), outc_weight, outc_bias, sums);
            write_pixels(sums, color, image, y + i, x, width, width, rows, columns, top);
        }
#elif defined(SKIP)
        if (any_bit(differs)) changes[tile_y * ((out_columns - 2) / 4) + TILE(t)] = 1;
#endif
    }
}
