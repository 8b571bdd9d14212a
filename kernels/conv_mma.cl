// SPDX-License-Identifier: MIT
// Building block conv on matrix units, reference stss_ref/conv.py::conv and ::gated: 3 x 3, stride 1 or 2, activations
// and weights in half, sums in float32. Eight channels of a pixel lie together in the buffers, which is the order that
// matrix units need. Arguments and buffers are conv.cl's, but
//
//  weight       in   (OUT / OUTPUTS, CHUNKS, STEPS, MATRICES, MATRIX) of uint: in the order in which work-items read
//                    them, the gate's among them; see stss_cl/network/pack_weights.py::fragments
//  gate_weight       not read
//
// Build -D STORED=HALF -D A -D B -D OUT (multiples of 8, or A is 4 and B 0) -D OUTPUTS (of a work-group) -D
// EIGHTS_AT_ONCE (of channels at once, a divisor of all) -D STRIDE -D ROWS (1 or 2), optionally -D EMULATE (mma.clh) -D
// GATED -D RELU -D MARK (change_map.clh) -D IMAGES (conv_local.cl).
// Work-group (LANES, WAVES): 32 x 4 ROWS pixels, a tile of the list; launch (LANES groups, WAVES OUT / OUTPUTS): a
// group computes some tiles, and copies its weights into local memory once if all channels fit at once.
//
// LANES work-items, a wave, multiply UNIT pixels x 16 channels by 16 channels x 8 outputs at once (mma.clh), for two
// such units beside each other in ROWS rows. A matrix of weights has eight outputs in a row; with GATED the last one
// has the gate for each part. The inner dimension runs over eights within taps within chunks; at stride 2 even columns
// lie before odd ones. Results go through local memory, so that neighbours store 16 bytes each in a row.
#if !defined(A) || !defined(B) || !defined(OUT) || !defined(OUTPUTS) || !defined(EIGHTS_AT_ONCE) || \
    !defined(STRIDE) || !defined(ROWS)
#error "conv_mma.cl needs -D A, B, OUT, OUTPUTS, EIGHTS_AT_ONCE, STRIDE, ROWS"
#endif
#include "common.clh"
#include "tile_list.clh"
#include "layer.clh"
#include "mma.clh"

#define ITEMS (LANES * WAVES)
#define CHUNKS ((A + B + 7) / 8 / EIGHTS_AT_ONCE)
#define STEPS ((9 * EIGHTS_AT_ONCE + 1) / 2)
#define EIGHTS (OUTPUTS / 8)
#ifdef GATED
#define MATRICES (EIGHTS + 1)
#else
#define MATRICES EIGHTS
#endif
#define READ_WIDE (STRIDE * 31 + 3)
#define READ_TALL (STRIDE * (4 * ROWS - 1) + 3)
#define PITCH (34 * STRIDE)
#define PLANE (PITCH * READ_TALL + 2)  // places of 16 bytes
#define COLUMN(x) (STRIDE == 2 ? (x) % 2 * 34 + (x) / 2 : (x))
#define TILE_PIXELS (32 * 4 * ROWS)
#define RESULT_PLANE (TILE_PIXELS + (7 + EIGHTS) / EIGHTS)  // so values that neighbours store lie in different banks
#define MOST(a, b) ((a) > (b) ? (a) : (b))
// Loads of a work-item, and those before it stores the first of them: all, or equal parts.
#define LOADS ((EIGHTS_AT_ONCE * READ_WIDE * READ_TALL + ITEMS - 1) / ITEMS)
#define LOADS_AT_ONCE ((LOADS + (LOADS + 7) / 8 - 1) / ((LOADS + 7) / 8))
// Offset of step j's place from the first tap's, in places.
#define TAP_AT(j) ((j) % EIGHTS_AT_ONCE * PLANE + (j) / EIGHTS_AT_ONCE / 3 * PITCH + COLUMN((j) / EIGHTS_AT_ONCE % 3))

// Loads eight channels of each input pixel of the tile; see conv_local.cl.
static inline void fetch_eights(global const ushort *a, global const ushort *b, local uint4 *tile, const int item,
                                const int first, const int top, const int left, const int in_rows, const int in_columns)
{
    const int count = EIGHTS_AT_ONCE * READ_WIDE * READ_TALL;
    for (int begin = item; begin < count; begin += LOADS_AT_ONCE * ITEMS) {
        uint4 held[LOADS_AT_ONCE];
        UNROLL
        for (int k = 0; k < LOADS_AT_ONCE; ++k) {
            const int i = least(begin + k * ITEMS, count - 1), eight = first + i % EIGHTS_AT_ONCE;
            const int x = i / EIGHTS_AT_ONCE % READ_WIDE, y = i / EIGHTS_AT_ONCE / READ_WIDE;
            const int place = least(top + y, in_rows - 1) * in_columns + least(left + x, in_columns - 1);
#if A == 4
            held[k] = (uint4)(((global const uint2 *)a)[place], 0, 0);
#else
            held[k] = eight < A / 8 ? ((global const uint4 *)a)[place * (A / 8) + eight]
                                    : ((global const uint4 *)b)[place * (B / 8) + eight - A / 8];
#endif
        }
        UNROLL
        for (int k = 0; k < LOADS_AT_ONCE; ++k) {
            const int i = begin + k * ITEMS;
            const int x = i / EIGHTS_AT_ONCE % READ_WIDE, y = i / EIGHTS_AT_ONCE / READ_WIDE;
            if (i < count) tile[i % EIGHTS_AT_ONCE * PLANE + y * PITCH + COLUMN(x)] = held[k];
        }
    }
}

// The initial sums of a work-item's product n; `bias` is that of the group's outputs.
static inline float4 begin(global const float *bias, const float gate_bias, const int n, const int lane)
{
    const float2 v = n < EIGHTS ? vload2(4 * n + PART(lane), bias) : (float2)(gate_bias);
    return (float4)(v, v);
}

// The gate of a work-item's k-th pixel: the first value of its part.
static inline float opening(const float4 sum, const int k)
{
    return 1.0f / (1.0f + exp(-(k ? sum.z : sum.x)));
}

kernel __attribute__((reqd_work_group_size(LANES, WAVES, 1))) void conv_mma(
    global const ushort *restrict a, global const ushort *restrict b, global const uint *restrict weight,
    global const uint *restrict gate_weight, global const float *restrict bias, const float gate_bias,
    global ushort *restrict out, const Layer layer, global const uint *restrict tiles, global const int *restrict count,
    global uchar *restrict changes)
{
    local uint4 tile[MOST(EIGHTS_AT_ONCE * PLANE, EIGHTS * RESULT_PLANE)];
    local uint4 matrices[STEPS * MATRICES * MATRIX / 4];
    EXCHANGE(exchange);
    const int lane = get_local_id(0), wave = get_local_id(1), item = wave * LANES + lane, block = get_group_id(1);
    const int in_rows = (STRIDE * layer.height + 3) / 4 * 4 + 2;
    // The wave's first pixel in the tile.
    const int across = wave % (WAVES / 4) * 2 * UNIT, down = wave / (WAVES / 4) * ROWS;
    local const uint4 *under = tile + (STRIDE * down * PITCH + across);
    a += layer.a_first;

    for (int t = get_group_id(0); t < count[0]; t += get_num_groups(0)) {
#ifdef IMAGES
        const int which = TILE_ROW(tiles[t]) / layer.tile_rows;
#else
        const int which = 0;
#endif
        global const ushort *from_a = a + which * layer.a_next;
        global ushort *to = out + which * layer.out_next;
        const int top = (TILE_ROW(tiles[t]) - which * layer.tile_rows) * 4 * ROWS;
        const int left = TILE_COLUMN(tiles[t]) * 32;
        float4 sum[2 * ROWS][MATRICES];  // for pixels UNIT (i % 2) .. of row i / 2
        UNROLL
        for (int n = 0; n < MATRICES; ++n) {
            const float4 v = begin(bias + block * OUTPUTS, gate_bias, n, lane);
            UNROLL
            for (int i = 0; i < 2 * ROWS; ++i) sum[i][n] = v;
        }
        for (int chunk = 0; chunk < CHUNKS; ++chunk) {
            barrier(CLK_LOCAL_MEM_FENCE);
            if (CHUNKS > 1 || t == (int)get_group_id(0)) {
                global const uint4 *from =
                    (global const uint4 *)weight + (block * CHUNKS + chunk) * STEPS * MATRICES * MATRIX / 4;
#pragma unroll 4
                for (int i = item; i < STEPS * MATRICES * MATRIX / 4; i += ITEMS) matrices[i] = from[i];
            }
            fetch_eights(from_a, b, tile, item, chunk * EIGHTS_AT_ONCE, STRIDE * top, STRIDE * left, in_rows,
                         layer.in_columns);
            barrier(CLK_LOCAL_MEM_FENCE);
            UNROLL
            for (int step = 0; step < STEPS; ++step) {
                // The last eight may have no partner: the other half has weights of 0.
                const int from = TAP_AT(2 * step),
                          then = TAP_AT(2 * step + 1 < 9 * EIGHTS_AT_ONCE ? 2 * step + 1 : 2 * step);
                uint2 w[MATRICES];
                UNROLL
                for (int n = 0; n < MATRICES; ++n)
                    w[n] = read_weights((local const uint *)matrices + (step * MATRICES + n) * MATRIX, lane);
                UNROLL
                for (int i = 0; i < 2 * ROWS; ++i) {
                    local const uint4 *p = under + STRIDE * (i / 2) * PITCH + i % 2 * UNIT;
                    const uint4 v = read_inputs(p + from, p + then, lane);
                    UNROLL
                    for (int n = 0; n < MATRICES; ++n) MULTIPLY_ADD(sum[i][n], v, w[n], exchange, wave, lane);
                }
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        UNROLL
        for (int i = 0; i < 2 * ROWS * ITS; ++i) {
            const int pixel = (down + i / ITS / 2) * 32 + across + i / ITS % 2 * UNIT + PIXEL(lane, i % ITS);
#ifdef GATED
            const float open = opening(sum[i / ITS][EIGHTS], i % ITS);
#endif
            UNROLL
            for (int n = 0; n < EIGHTS; ++n) {
                float2 value = OF_PIXEL(sum[i / ITS][n], i % ITS);
#ifdef GATED
                value *= open;
#endif
#ifdef RELU
                value = fmax(value, 0.0f);
#endif
                ((local uint *)(tile + n * RESULT_PLANE + pixel))[PART(lane)] = as_uint(narrow(value));
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int i = item; i < EIGHTS * TILE_PIXELS; i += ITEMS) {
            const int n = i % EIGHTS, pixel = i / EIGHTS, x = left + pixel % 32, y = top + pixel / 32;
            if (x >= layer.width || y >= layer.height) continue;
            BEGIN_PIXEL;
            PUT_STORED8(as_ushort8(tile[n * RESULT_PLANE + pixel]),
                        ((y + 1) * layer.out_columns + x + 1) * (layer.out_channels / 8) + layer.out_first / 8 +
                            block * EIGHTS + n,
                        to);
            END_PIXEL(which * layer.map_next + y * (layer.out_columns - 2) + x);
        }
    }
}
