// SPDX-License-Identifier: MIT
// Building block conv, reference stss_ref/conv.py::conv and ::gated: 3 x 3 or 1 x 1, stride 1 or 2, one or two inputs
// side by side.
//
//  buffer       dir  shape                              content
//  a            in   padded, (A)                        first input, see common.clh; it begins at layer.a_first
//  b            in   padded, (B)                        second input, concatenated behind it; not read where B = 0
//  weight       in   (KERNEL, KERNEL, A + B, OUT)       tap by tap, outputs last
//  gate_weight  in   (KERNEL, KERNEL, A + B)            of the one gate channel; read if GATED
//  bias         in   (OUT)
//  out          out  padded, (layer.out_channels)       OUT channels of it, from layer.out_first on
//
// Build -D A -D B -D OUT (multiples of 8; A may be 4 where not GATED) -D KERNEL -D STRIDE -D PIXELS (1, 2 or 4) -D
// EIGHTS_HELD (float8 of outputs held at once) -D GROUP (work-group along x) -D WORKERS (16 / PIXELS, or a divisor of
// it), optionally -D GATED -D RELU -D STORED. stss_cl/device/tuning.toml has PIXELS, EIGHTS_HELD and GROUP of each kind
// of device.
//
// One work-item holds PIXELS x EIGHTS_HELD accumulators of eight channels: 4 x 3 and 2 x 4 fill a CPU's registers.
// `tiles`, `count`: the tiles of 4 x 4 pixels of the output that are computed, see tile_list.clh. Launch (any multiple
// of WORKERS, OUT / 8 / EIGHTS_HELD or a divisor of it).
//
// If MARKS(changes), the output's map, a value is compared with the stored one, and marked if bits differ
// (change_map.clh).
#if !defined(A) || !defined(B) || !defined(OUT) || !defined(KERNEL) || !defined(STRIDE) || !defined(PIXELS) || \
    !defined(EIGHTS_HELD) || !defined(GROUP)
#error "conv.cl needs -D A, B, OUT, KERNEL, STRIDE, PIXELS, EIGHTS_HELD, GROUP"
#endif
#if PIXELS != 1 && PIXELS != 2 && PIXELS != 4
#error "conv.cl: PIXELS is 1, 2 or 4"
#endif
#include "common.clh"
#include "tile_list.clh"
#include "layer.clh"

#define IN (A + B)
#define OUT8 (OUT / 8)
#define PAD (KERNEL / 2)

// Adds one tap of one input, `count` channels of PIXELS pixels, to the accumulators.
#define TAP(buffer, channels, first)                                                                      \
    from = buffer + (at + shift) * channels;                                                              \
    for (int c = 0; c < channels; ++c) {                                                                  \
        float8 w[EIGHTS_HELD];                                                                            \
        _Pragma("unroll") for (int j = 0; j < EIGHTS_HELD; ++j) w[j] = taps[(first + c) * OUT8 + j];      \
        _Pragma("unroll") for (int p = 0; p < PIXELS; ++p)                                                \
        {                                                                                                 \
            const float8 v = (float8)(LOAD(from, p * STRIDE * channels + c));                             \
            _Pragma("unroll") for (int j = 0; j < EIGHTS_HELD; ++j) sum[p * EIGHTS_HELD + j] += v * w[j]; \
        }                                                                                                 \
    }

// clang-format off
// Four eights at a time: twelve at once would take more registers than AMD's GPUs have.
#define GATE_TAP(buffer, channels, first)                                                                                 \
    _Pragma("unroll 4") for (int c = 0; c < channels / 8; ++c) {                                                          \
        const float8 w = gate_weight[tap * (IN / 8) + first / 8 + c];                                                     \
        _Pragma("unroll") for (int p = 0; p < PIXELS; ++p)                                                                \
            gate[p] += LOAD8(buffer, (at + shift + p * STRIDE) * (channels / 8) + c) * w;                                 \
    }
// clang-format on

// PIXELS pixels from (y, x0) on, EIGHTS_HELD eights of channels from `block` on.
static inline void compute(global const stored *restrict a, global const stored *restrict b,
                           global const float8 *restrict weight, global const float8 *restrict gate_weight,
                           global const float8 *restrict bias, const float gate_bias, global stored *restrict out,
                           const Layer layer, const int block, const int x0, const int y,
                           global uchar *restrict changes)
{
    // Input pixel under the kernel's corner. Pixels behind the row's end are computed, too, from any values there, but
    // not stored.
    const int at = (y * STRIDE + 1 - PAD) * layer.in_columns + x0 * STRIDE + 1 - PAD;
    global const stored *from;

    float8 sum[PIXELS * EIGHTS_HELD];
#pragma unroll
    for (int i = 0; i < PIXELS * EIGHTS_HELD; ++i) sum[i] = bias[block + i % EIGHTS_HELD];
#pragma unroll 1
    for (int tap = 0; tap < KERNEL * KERNEL; ++tap) {
        const int shift = tap / KERNEL * layer.in_columns + tap % KERNEL;
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
#pragma unroll 1
    for (int tap = 0; tap < KERNEL * KERNEL; ++tap) {
        const int shift = tap / KERNEL * layer.in_columns + tap % KERNEL;
        GATE_TAP(a, A, 0)
#if B
        GATE_TAP(b, B, A)
#endif
    }
#endif

#pragma unroll
    for (int p = 0; p < PIXELS; ++p) {
        if (x0 + p >= layer.width) continue;
        const int pixel =
            ((y + 1) * layer.out_columns + x0 + p + 1) * (layer.out_channels / 8) + layer.out_first / 8 + block;
#ifdef GATED
        const float8 open = sigmoid8((float8)(sum8(gate[p]) + gate_bias));
#endif
        BEGIN_PIXEL;
#pragma unroll
        for (int j = 0; j < EIGHTS_HELD; ++j) {
            float8 value = sum[p * EIGHTS_HELD + j];
#ifdef GATED
            value *= open;
#endif
#ifdef RELU
            value = relu8(value);
#endif
            PUT(value, pixel + j, out);
        }
        END_PIXEL(y * (layer.out_columns - 2) + x0 + p);
    }
}

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void conv(
    global const stored *restrict a, global const stored *restrict b, global const float8 *restrict weight,
    global const float8 *restrict gate_weight, global const float8 *restrict bias, const float gate_bias,
    global stored *restrict out, const Layer layer, global const uint *restrict tiles, global const int *restrict count,
    global uchar *restrict changes)
{
    a += layer.a_first;
    const int2 part = part_of_list(count[0], 1);
    for (int t = part.x; t < part.y; ++t) {
        const int top = 4 * TILE_ROW(tiles[t]), left = 4 * TILE_COLUMN(tiles[t]);
        for (int i = PIXELS * WORKER; i < 16; i += PIXELS * WORKERS) {
            const int y = top + i / 4, x = left + i % 4;
            if (y >= layer.height || x >= layer.width) continue;
            for (int block = get_global_id(1) * EIGHTS_HELD; block < OUT8; block += get_global_size(1) * EIGHTS_HELD)
                compute(a, b, weight, gate_weight, bias, gate_bias, out, layer, block, x, y, changes);
        }
    }
}
