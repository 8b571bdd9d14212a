// SPDX-License-Identifier: MIT
// Building block conv for GPUs, reference stss_ref/conv.py::conv and ::gated: 3 x 3, stride 1 or 2. A work-group copies
// a tile of the input and its weights into local memory; a work-item holds eight outputs of 4 x ROWS pixels in
// registers. Buffers and weights as in conv.cl.
//
// Build -D A -D B -D OUT (multiples of 8; A may be 4 where not GATED) -D SLICES (eights of outputs of a work-group) -D
// STRIDE -D ROWS (1 or 2: pixels of a work-item, one above the other), optionally -D GATED -D RELU -D STORED -D MARK
// (change_map.clh).  Work-group (8, 4, SLICES): 32 x 4 ROWS pixels, a tile of the list (tile_list.clh); launch (8
// tiles, 4, OUT / 8).
// -D IMAGES: several one behind the other, and the list's rows likewise (layer.clh).
//
// 32 neighbouring work-items form 8 x 4 and compute the same eight outputs: their weights are a broadcast, and their
// inputs are 128 bytes in a row. The tile takes CHUNK channels at a time, one plane each; at stride 2 even columns lie
// before odd ones.
#if !defined(A) || !defined(B) || !defined(OUT) || !defined(SLICES) || !defined(STRIDE) || !defined(ROWS)
#error "conv_local.cl needs -D A, B, OUT, SLICES, STRIDE, ROWS"
#endif
#include "common.clh"
#include "tile_list.clh"
#include "layer.clh"

#define IN (A + B)
#define WIDE 32
#define TALL (4 * ROWS)
#define CHUNK (STRIDE == 2 || A == 4 ? 4 : 8)
#define READ_WIDE (STRIDE * (WIDE - 1) + 3)
#define READ_TALL (STRIDE * (TALL - 1) + 3)
#define PITCH (36 * STRIDE)  // floats of a row of the tile: whole float4s
#define PLANE ((PITCH * READ_TALL + 7) / 8 * 8 + 4)  // so neighbouring planes begin in different banks
#define QUADS (2 * CHUNK * SLICES)  // groups of four weights of a tap
#define ITEMS (32 * SLICES)
#define TILE_FLOATS (CHUNK * PLANE)
#define PIXELS (4 * ROWS)
#define READ_FOR(r) (STRIDE * (r) + 3)

// A work-item holds all lines of the input that its pixels read; or only those of one row of taps, if its rows of
// pixels share few lines and all would take many registers.
#if STRIDE == 2 && ROWS == 2
#define TAPS_AT_ONCE 3
#define LINES ROWS
#define LINE(r) (STRIDE * (r))
#define INPUT(tap, i) in[(i) / 4][STRIDE * ((i) % 4) + (tap)]
#else
#define TAPS_AT_ONCE 9
#define LINES READ_FOR(ROWS - 1)
#define LINE(r) (r)
#define INPUT(tap, i) in[STRIDE * ((i) / 4) + (tap) / 3][STRIDE * ((i) % 4) + (tap) % 3]
#endif

#if STRIDE == 2
#define COLUMN(x) ((x) % 2 * 36 + (x) / 2)
#else
#define COLUMN(x) (x)
#endif

#if STORED == HALF
#define READ4(buffer, i) vload_half4(i, (global const half *)(buffer))
#else
#define READ4(buffer, i) LOAD4(buffer, i)
#endif

// Loads channels `first` .. first + CHUNK - 1 of the tile's input pixels; its corner is the buffers' pixel (top, left).
// Only pixels that are not stored read values beyond the buffers.
static inline void fetch_floats(global const stored *a, global const stored *b, local float *tile, const int item,
                                const int first, const int top, const int left, const int in_rows, const int in_columns)
{
    for (int i = item; i < CHUNK / 4 * READ_WIDE * READ_TALL; i += ITEMS) {
        const int quad = i % (CHUNK / 4), x = i / (CHUNK / 4) % READ_WIDE, y = i / (CHUNK / 4) / READ_WIDE;
        const int place = least(top + y, in_rows - 1) * in_columns + least(left + x, in_columns - 1);
        const float4 v =
            B && first >= A ? READ4(b, (place * B + first - A) / 4 + quad) : READ4(a, (place * A + first) / 4 + quad);
        local float *to = tile + 4 * quad * PLANE + y * PITCH + COLUMN(x);
        to[0] = v.x;
        to[PLANE] = v.y;
        to[2 * PLANE] = v.z;
        to[3 * PLANE] = v.w;
    }
}

// The values that a work-item reads from one row of a plane: in[x] is x columns right of the input of its first pixel's
// left tap.
static inline void read_row(local const float *from, float *in)
{
    const float4 v = *(local const float4 *)from;
#if STRIDE == 2
    const float4 u = *(local const float4 *)(from + 36);
    in[0] = v.x, in[2] = v.y, in[4] = v.z, in[6] = v.w, in[8] = from[4];
    in[1] = u.x, in[3] = u.y, in[5] = u.z, in[7] = u.w;
#else
    const float2 u = *(local const float2 *)(from + 4);
    in[0] = v.x, in[1] = v.y, in[2] = v.z, in[3] = v.w, in[4] = u.x, in[5] = u.y;
#endif
}

kernel __attribute__((reqd_work_group_size(8, 4, SLICES))) void conv_local(
    global const stored *restrict a, global const stored *restrict b, global const float *restrict weight,
    global const float *restrict gate_weight, global const float8 *restrict bias, const float gate_bias,
    global stored *restrict out, const Layer layer, global const uint *restrict tiles, global const int *restrict count,
    global uchar *restrict changes)
{
    local float tile[TILE_FLOATS] __attribute__((aligned(16)));
    local float taps[9 * CHUNK * 8 * SLICES] __attribute__((aligned(32)));
    local float gates[9 * CHUNK];
    const int lx = get_local_id(0), ly = get_local_id(1), slice = get_local_id(2), item = (slice * 4 + ly) * 8 + lx;
    const int eight = get_global_id(2), from_quad = 2 * SLICES * get_group_id(2);
    const int in_rows = (STRIDE * layer.height + 3) / 4 * 4 + 2;
    a += layer.a_first;

    for (int t = get_group_id(0); t < count[0]; t += get_num_groups(0)) {
#ifdef IMAGES
        const int which = TILE_ROW(tiles[t]) / layer.tile_rows,
                  up = (TILE_ROW(tiles[t]) - which * layer.tile_rows) * TALL;
        global const stored *from_a = a + which * layer.a_next;
        global stored *to = out + which * layer.out_next;
#else
        const int up = TILE_ROW(tiles[t]) * TALL;
        global const stored *from_a = a;
        global stored *to = out;
#endif
        const int left = TILE_COLUMN(tiles[t]) * WIDE;
        float8 sum[PIXELS];
        float gate[8];
#pragma unroll
        for (int i = 0; i < PIXELS; ++i) sum[i] = bias[eight];
#pragma unroll
        for (int i = 0; i < 8; ++i) gate[i] = 0.0f;

        for (int first = 0; first < IN; first += CHUNK) {
            barrier(CLK_LOCAL_MEM_FENCE);
            fetch_floats(from_a, b, tile, item, first, STRIDE * up, STRIDE * left, in_rows, layer.in_columns);
            for (int i = item; i < 9 * QUADS; i += ITEMS)
                ((local float4 *)taps)[i] =
                    ((global const float4 *)weight)[(i / QUADS * IN + first + i % QUADS / (2 * SLICES)) * (OUT / 4) +
                                                    from_quad + i % (2 * SLICES)];
#ifdef GATED
            for (int i = item; i < 9 * CHUNK; i += ITEMS) gates[i] = gate_weight[i / CHUNK * IN + first + i % CHUNK];
#endif
            barrier(CLK_LOCAL_MEM_FENCE);

#pragma unroll 1
            for (int c = 0; c < CHUNK; ++c) {
                local const float *from = tile + c * PLANE + STRIDE * ROWS * ly * PITCH + 4 * lx;
#pragma unroll 1
                for (int first_tap = 0; first_tap < 9; first_tap += TAPS_AT_ONCE) {
                    float in[LINES][READ_FOR(3)];
#pragma unroll
                    for (int r = 0; r < LINES; ++r) read_row(from + (LINE(r) + first_tap / 3) * PITCH, in[r]);
#pragma unroll
                    for (int tap = 0; tap < TAPS_AT_ONCE; ++tap) {
                        const float8 w =
                            *(local const float8 *)(taps + (((first_tap + tap) * CHUNK + c) * SLICES + slice) * 8);
#pragma unroll
                        for (int i = 0; i < PIXELS; ++i) sum[i] += w * INPUT(tap, i);
                    }
#ifdef GATED
                    // The slices share the gate's channels.
                    if (c % SLICES == slice) {
#pragma unroll
                        for (int tap = 0; tap < TAPS_AT_ONCE; ++tap) {
                            const float w = gates[(first_tap + tap) * CHUNK + c];
#pragma unroll
                            for (int i = 0; i < PIXELS; ++i) gate[i] += w * INPUT(tap, i);
                        }
                    }
#endif
                }
            }
        }

#ifdef GATED
        // Adds the slices' sums, through the tile's memory.
        local float *parts = tile + PIXELS * (ly * 8 + lx);
        barrier(CLK_LOCAL_MEM_FENCE);
#pragma unroll
        for (int i = 0; i < PIXELS; ++i) parts[slice * WIDE * TALL + i] = gate[i];
        barrier(CLK_LOCAL_MEM_FENCE);
#pragma unroll
        for (int i = 0; i < PIXELS; ++i) {
            gate[i] = gate_bias;
#pragma unroll
            for (int s = 0; s < SLICES; ++s) gate[i] += parts[s * WIDE * TALL + i];
        }
        const float8 open = sigmoid8((float8)(gate[0], gate[1], gate[2], gate[3], gate[4], gate[5], gate[6], gate[7]));
        const float opens[8] = {open.s0, open.s1, open.s2, open.s3, open.s4, open.s5, open.s6, open.s7};
#endif
#pragma unroll
        for (int i = 0; i < PIXELS; ++i) {
            const int x = left + 4 * lx + i % 4, y = up + ROWS * ly + i / 4;
            if (x >= layer.width || y >= layer.height) continue;
            float8 value = sum[i];
            BEGIN_PIXEL;
#ifdef GATED
            value *= opens[i];
#endif
#ifdef RELU
            value = relu8(value);
#endif
            PUT(value, ((y + 1) * layer.out_columns + x + 1) * (layer.out_channels / 8) + layer.out_first / 8 + eight,
                to);
#ifdef IMAGES
            END_PIXEL(which * layer.map_next + y * (layer.out_columns - 2) + x);
#else
            END_PIXEL(y * (layer.out_columns - 2) + x);
#endif
        }
    }
}
