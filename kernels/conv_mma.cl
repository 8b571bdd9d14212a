// Building block conv on matrix units, reference stss_ref/conv.py::conv and ::gated: 3 x 3, stride 1 or 2, activations and weights in half, sums
// in float32. Eight channels of a pixel lie together in the buffers, which is the order that matrix units want. Arguments and buffers are conv.cl's, but
//
//  weight       in   (OUT / BLOCK, CHUNKS, STEPS, MATRICES, 32) of uint2: in the order in which work-items want them, and the gate's with them,
//                    stss_cl/network/pack_weights.py::fragments
//  gate_weight       not read
//
// Build -D HALF -D A -D B -D OUT -D BLOCK (outputs of a work-group) -D EIGHTS (of channels at once, a divisor of (A + B) / 8) -D STRIDE -D ROWS (1 or 2),
// all channels multiples of 8, optionally -D GATED -D RELU -D MARK; -D EMULATE: without matrix units, on any device.
// -D IMAGES: see conv_local.cl.
// Work-group (32, 4): 32 x 4 ROWS pixels, a tile of the list; launch (32 tiles, 4 OUT / BLOCK).
//
// 32 work-items multiply 16 pixels x 16 channels by 16 channels x 8 outputs at once: mma.sync.m16n8k16 of NVIDIA from sm_80 on. The
// inner dimension runs over eights within taps within chunks; at stride 2 even columns lie before odd ones.
#if !defined(HALF) || !defined(A) || !defined(B) || !defined(OUT) || !defined(BLOCK) || !defined(EIGHTS) || !defined(STRIDE) || !defined(ROWS)
#error "conv_mma.cl needs -D HALF, A, B, OUT, BLOCK, EIGHTS, STRIDE, ROWS"
#endif
#include "common.clh"
#include "tile_list.clh"
#include "mma.clh"

#define CHUNKS ((A + B) / 8 / EIGHTS)
#define STEPS ((9 * EIGHTS + 1) / 2)
#ifdef GATED
#define MATRICES (BLOCK / 8 + 1)  // the gate's is eight times the same column, so that each work-item finds its pixels' gate beside their sums
#else
#define MATRICES (BLOCK / 8)
#endif
#define READ_WIDE (STRIDE * 31 + 3)
#define READ_TALL (STRIDE * (4 * ROWS - 1) + 3)
#define PITCH (34 * STRIDE)
#define PLANE (PITCH * READ_TALL + 2)  // places of 16 bytes
#define COLUMN(x) (STRIDE == 2 ? (x) % 2 * 34 + (x) / 2 : (x))
#define TAP_AT(j) (((j) % EIGHTS * PLANE + (j) / EIGHTS / 3 * PITCH + COLUMN((j) / EIGHTS % 3)) * 4)  // uints from the first tap's to those of step j

// Eight channels of each pixel under the tile; see conv_local.cl.
static inline void fetch(global const ushort *a, global const ushort *b, local uint4 *tile, const int item, const int first,
                         const int top, const int left, const int in_rows, const int in_columns)
{
    for (int i = item; i < EIGHTS * READ_WIDE * READ_TALL; i += 128) {
        const int e = i % EIGHTS, x = i / EIGHTS % READ_WIDE, y = i / EIGHTS / READ_WIDE, eight = first + e;
        const int place = least(top + y, in_rows - 1) * in_columns + least(left + x, in_columns - 1);
        tile[e * PLANE + y * PITCH + COLUMN(x)] = eight < A / 8 ? ((global const uint4 *)a)[place * (A / 8) + eight]
                                                                : ((global const uint4 *)b)[place * (B / 8) + eight - A / 8];
    }
}

// Two neighbouring outputs of a pixel.
static inline void put2(const float2 value, global ushort *to, global uchar *changed)
{
    const ushort2 after = narrow2(value);
#ifdef MARK
    const ushort2 before = *(global const ushort2 *)to;
    if (as_uint(after) != as_uint(before)) *changed = 1;
#endif
    *(global ushort2 *)to = after;
}

kernel __attribute__((reqd_work_group_size(32, 4, 1)))
void conv_mma(global const ushort *restrict a, global const ushort *restrict b, global const uint2 *restrict weight,
              global const uint2 *restrict gate_weight, global const float *restrict bias, const float gate_bias,
              global ushort *restrict out, const int a_first, const int height, const int width, const int in_columns,
              const int out_columns, const int out_channels, const int out_first
#ifdef IMAGES
              , const int a_next, const int out_next, const int map_next, const int tile_rows
#endif
              , global const uint *restrict tiles, global const int *restrict count, global uchar *restrict changes)
{
    local uint4 tile[EIGHTS * PLANE];
    EXCHANGE(exchange);
    const int lane = get_local_id(0), warp = get_local_id(1), item = warp * 32 + lane, block = get_group_id(1);
    const int in_rows = (STRIDE * height + 3) / 4 * 4 + 2;
    global const uint2 *weights = weight + block * CHUNKS * STEPS * MATRICES * 32 + lane;
    // The first pixel's channels of this work-item under the first tap.
    local const uint *mine = (local const uint *)tile + (STRIDE * ROWS * warp * PITCH + lane / 4) * 4 + lane % 4;
    a += a_first;

    for (int t = get_group_id(0); t < count[0]; t += get_num_groups(0)) {
#ifdef IMAGES
        const int which = TILE_ROW(tiles[t]) / tile_rows, top = (TILE_ROW(tiles[t]) - which * tile_rows) * 4 * ROWS;
        global const ushort *from_a = a + which * a_next;
        global ushort *to = out + which * out_next;
        global uchar *marks = changes + which * map_next;
#else
        const int top = TILE_ROW(tiles[t]) * 4 * ROWS;
        global const ushort *from_a = a;
        global ushort *to = out;
        global uchar *marks = changes;
#endif
        const int left = TILE_COLUMN(tiles[t]) * 32;
        float4 sum[2 * ROWS][MATRICES];  // pixels 16 (i % 2) .. of row i / 2, by outputs
UNROLL
        for (int n = 0; n < MATRICES; ++n) {
            const float2 v = n < BLOCK / 8 ? *(global const float2 *)(bias + block * BLOCK + 8 * n + 2 * (lane % 4)) : (float2)(gate_bias);
UNROLL
            for (int i = 0; i < 2 * ROWS; ++i) sum[i][n] = (float4)(v, v);
        }
        for (int chunk = 0; chunk < CHUNKS; ++chunk) {
            barrier(CLK_LOCAL_MEM_FENCE);
            fetch(from_a, b, tile, item, chunk * EIGHTS, STRIDE * top, STRIDE * left, in_rows, in_columns);
            barrier(CLK_LOCAL_MEM_FENCE);
UNROLL
            for (int step = 0; step < STEPS; ++step) {
                // The last eight may have no partner: the other half is multiplied by weights of 0.
                const int from = TAP_AT(2 * step), then = TAP_AT(2 * step + 1 < 9 * EIGHTS ? 2 * step + 1 : 2 * step);
                uint2 w[MATRICES];
UNROLL
                for (int n = 0; n < MATRICES; ++n) w[n] = weights[((chunk * STEPS + step) * MATRICES + n) * 32];
UNROLL
                for (int i = 0; i < 2 * ROWS; ++i) {
                    local const uint *p = mine + (STRIDE * (i / 2) * PITCH + i % 2 * 16) * 4;
                    const uint4 v = (uint4)(p[from], p[from + 32], p[then], p[then + 32]);
UNROLL
                    for (int n = 0; n < MATRICES; ++n) MULTIPLY_ADD(sum[i][n], v, w[n], exchange, warp, lane);
                }
            }
        }
UNROLL
        for (int i = 0; i < 4 * ROWS; ++i) {
            const int x = left + i / 2 % 2 * 16 + i % 2 * 8 + lane / 4, y = top + ROWS * warp + i / 4;
            if (x >= width || y >= height) continue;
            const int pixel = ((y + 1) * out_columns + x + 1) * out_channels + out_first + block * BLOCK + 2 * (lane % 4);
#ifdef GATED
            const float open = 1.0f / (1.0f + exp(i % 2 ? -sum[i / 2][BLOCK / 8].z : -sum[i / 2][BLOCK / 8].x));
#endif
UNROLL
            for (int n = 0; n < BLOCK / 8; ++n) {
                float2 value = i % 2 ? sum[i / 2][n].zw : sum[i / 2][n].xy;
#ifdef GATED
                value *= open;
#endif
#ifdef RELU
                value = fmax(value, 0.0f);
#endif
                put2(value, to + pixel + 8 * n, marks + y / 4 * ((out_columns - 2) / 4) + x / 4);
            }
        }
    }
}
