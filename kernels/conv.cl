// Building block conv, reference stss_ref/conv.py::conv and ::gated: 3 x 3 or 1 x 1, stride 1 or 2, one or two inputs side by side.
//
//  buffer       dir  shape                              content
//  a            in   padded, (A)                        first input, see common.clh; begins at element a_first
//  b            in   padded, (B)                        second input, concatenated behind it; not read where B = 0
//  weight       in   (KERNEL, KERNEL, A + B, OUT)       tap by tap, outputs last
//  gate_weight  in   (KERNEL, KERNEL, A + B)            of the one gate channel; read if GATED
//  bias         in   (OUT)
//  out          out  padded, (out_channels)             channels out_first .. out_first + OUT - 1 of it
//
// Build -D A -D B -D OUT (multiples of 8; A may be 4 where not GATED) -D KERNEL -D STRIDE -D PIXELS -D BLOCK (float8 of outputs held
// at once) -D GROUP (work-group along x), optionally -D GATED -D RELU -D HALF.  Launch (OUT / 8 / BLOCK, ceil(width / PIXELS), height) of the output.
//
// One work-item holds PIXELS x BLOCK accumulators of eight channels: 4 x 3 and 3 x 4 fill a CPU's registers.
//
// -D SKIP -D SPAN (a multiple of PIXELS) -D TALL: only pixels that a change reaches, see change_map.clh; a_changes (the map begins at
// a_tile), b_changes, changes are the maps of a, b, out. -D WANTED=n in its place: only pixels of tiles no farther than n tiles
// from one that the map `wanted` of `out` marks; stride 1. Launch (OUT / 8 / BLOCK, ceil(width / SPAN), ceil(height / TALL)).
#if !defined(A) || !defined(B) || !defined(OUT) || !defined(KERNEL) || !defined(STRIDE) || !defined(PIXELS) || !defined(BLOCK) || \
    !defined(GROUP)
#error "conv.cl needs -D A, B, OUT, KERNEL, STRIDE, PIXELS, BLOCK, GROUP"
#endif
#include "common.clh"
#if defined(SKIP) || defined(WANTED)
#include "change_map.clh"
#endif

#define IN (A + B)
#define OUT8 (OUT / 8)
#define PAD (KERNEL / 2)

// One tap of one input: `count` channels of PIXELS pixels into the accumulators.
#define TAP(buffer, channels, first)                                                                                      \
    from = buffer + (at + shift) * channels;                                                                              \
    for (int c = 0; c < channels; ++c) {                                                                                  \
        float8 w[BLOCK];                                                                                                  \
        _Pragma("unroll") for (int j = 0; j < BLOCK; ++j) w[j] = taps[(first + c) * OUT8 + j];                            \
        _Pragma("unroll") for (int p = 0; p < PIXELS; ++p) {                                                              \
            const float8 v = (float8)(LOAD(from, p * STRIDE * channels + c));                                                 \
            _Pragma("unroll") for (int j = 0; j < BLOCK; ++j) sum[p * BLOCK + j] += v * w[j];                             \
        }                                                                                                                 \
    }

#define GATE_TAP(buffer, channels, first)                                                                                 \
    for (int c = 0; c < channels / 8; ++c) {                                                                              \
        const float8 w = gate_weight[tap * (IN / 8) + first / 8 + c];                                                     \
        _Pragma("unroll") for (int p = 0; p < PIXELS; ++p)                                                                \
            gate[p] += LOAD8(buffer, (at + shift + p * STRIDE) * (channels / 8) + c) * w;                                 \
    }

// PIXELS pixels from (y, x0) on, BLOCK eights of channels from `block` on.
#if defined(SKIP) && defined(HALF)
__attribute__((noinline))  // inlined into the loop over what changed it takes PoCL half as long again
#endif
static inline void compute(global const stored *restrict a, global const stored *restrict b, global const float8 *restrict weight,
                           global const float8 *restrict gate_weight, global const float8 *restrict bias, const float gate_bias,
                           global stored *restrict out, const int width, const int in_columns, const int out_columns,
                           const int out_channels, const int out_first, const int block, const int x0, const int y
#ifdef SKIP
                           , global uchar *restrict changes, const float tolerance
#endif
                           )
{
    // Input pixel under the kernel's corner. Pixels beyond the row are computed too, from whatever lies there, and not stored.
    const int at = (y * STRIDE + 1 - PAD) * in_columns + x0 * STRIDE + 1 - PAD;
    global const stored *from;

    float8 sum[PIXELS * BLOCK];
#pragma unroll
    for (int i = 0; i < PIXELS * BLOCK; ++i) sum[i] = bias[block + i % BLOCK];
    for (int tap = 0; tap < KERNEL * KERNEL; ++tap) {
        const int shift = tap / KERNEL * in_columns + tap % KERNEL;
        global const float8 *restrict taps = weight + tap * IN * OUT8 + block;
        TAP(a, A, 0)
#if B
        TAP(b, B, A)
#endif
    }

#ifdef GATED
    float8 gate[PIXELS];
#pragma unroll
    for (int p = 0; p < PIXELS; ++p) gate[p] = 0.0f;
    for (int tap = 0; tap < KERNEL * KERNEL; ++tap) {
        const int shift = tap / KERNEL * in_columns + tap % KERNEL;
        GATE_TAP(a, A, 0)
#if B
        GATE_TAP(b, B, A)
#endif
    }
#endif

    for (int p = 0; p < PIXELS && x0 + p < width; ++p) {
        const int pixel = ((y + 1) * out_columns + x0 + p + 1) * (out_channels / 8) + out_first / 8 + block;
#ifdef GATED
        const float8 open = sigmoid8((float8)(sum8(gate[p]) + gate_bias));
#endif
#ifdef SKIP
        stored8 differs = 0;
#endif
        for (int j = 0; j < BLOCK; ++j) {
            float8 value = sum[p * BLOCK + j];
#ifdef GATED
            value *= open;
#endif
#ifdef RELU
            value = relu8(value);
#endif
#ifdef SKIP
            differs |= replace8(value, pixel + j, out, tolerance);
#else
            STORE8(value, pixel + j, out);
#endif
        }
#ifdef SKIP
        if (any_bit(differs)) changes[y / 4 * ((out_columns - 2) / 4) + (x0 + p) / 4] = 1;
#endif
    }
}

#ifdef SKIP
// Whether a change reaches pixels (top .. bottom, left .. right) of the output.
static inline int reached(global const uchar *a, global const uchar *b, const int rows, const int columns, const int top,
                          const int bottom, const int left, const int right)
{
    const int north = top * STRIDE - PAD, south = bottom * STRIDE + PAD, west = left * STRIDE - PAD, east = right * STRIDE + PAD;
    if (marked(a, rows, columns, north, south, west, east)) return 1;
    return B && marked(b, rows, columns, north, south, west, east);
}
#endif

kernel __attribute__((reqd_work_group_size(1, GROUP, 1)))
void conv(global const stored *restrict a, global const stored *restrict b, global const float8 *restrict weight,
          global const float8 *restrict gate_weight, global const float8 *restrict bias, const float gate_bias,
          global stored *restrict out, const int a_first, const int width, const int in_columns, const int out_columns,
          const int out_channels, const int out_first
#ifdef SKIP
          , global const uchar *restrict a_changes, global const uchar *restrict b_changes, global uchar *restrict changes,
          const int a_tile, const int height, const float tolerance
#elif defined(WANTED)
          , global const uchar *restrict wanted, const int height
#endif
          )
{
    const int block = get_global_id(0) * BLOCK;
    a += a_first;
#ifdef SKIP
    const int left = get_global_id(1) * SPAN, top = get_global_id(2) * TALL;
    const int right = min(left + SPAN, width), bottom = min(top + TALL, height);
    const int rows = (STRIDE * height + 3) / 4, columns = (in_columns - 2) / 4;
    a_changes += a_tile;
    if (!reached(a_changes, b_changes, rows, columns, top, bottom - 1, left, right - 1)) return;
    for (int y = top; y < bottom; ++y)
        for (int x = left; x < right; x += PIXELS)
            if (reached(a_changes, b_changes, rows, columns, y, y, x, x + PIXELS - 1))
                compute(a, b, weight, gate_weight, bias, gate_bias, out, width, in_columns, out_columns, out_channels, out_first,
                        block, x, y, changes, tolerance);
#elif defined(WANTED)
    const int left = get_global_id(1) * SPAN, top = get_global_id(2) * TALL;
    const int rows = (height + 3) / 4, columns = (in_columns - 2) / 4, reach = 4 * WANTED;
    for (int y = top; y < min(top + TALL, height); ++y)
        for (int x = left; x < min(left + SPAN, width); x += PIXELS)
            if (marked(wanted, rows, columns, y - reach, y + reach, x - reach, x + PIXELS - 1 + reach))
                compute(a, b, weight, gate_weight, bias, gate_bias, out, width, in_columns, out_columns, out_channels, out_first,
                        block, x, y);
#else
    const int x = get_global_id(1) * PIXELS, y = get_global_id(2);
    if (x < width)
        compute(a, b, weight, gate_weight, bias, gate_bias, out, width, in_columns, out_columns, out_channels, out_first,
                block, x, y);
#endif
}
