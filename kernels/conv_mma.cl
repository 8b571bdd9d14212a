// SPDX-License-Identifier: MIT
// Building block conv on matrix units, reference stss_ref/conv.py::conv and ::gated: 3 x 3, stride 1 or 2, activations
// and weights in half, sums in float32. Eight channels of a pixel lie together in the buffers, which is the order that
// matrix units need. Arguments and buffers are conv.cl's, but
//
//  weight       in   (OUT / OUTPUTS, CHUNKS, STEPS, MATRICES, MATRIX) of uint: in the order in which work-items want
//                    them, and the gate's with them,
//                    stss_cl/network/pack_weights.py::fragments
//  gate_weight       not read
//
// Build -D STORED=HALF -D A -D B -D OUT -D OUTPUTS (outputs of a work-group) -D EIGHTS_AT_ONCE (of channels at once, a
// divisor of (A + B) / 8) -D STRIDE -D ROWS (1 or 2), all channels multiples of 8; optionally -D EMULATE (mma.clh) -D
// GATED -D RELU -D MARK (change_map.clh).
// -D IMAGES: see conv_local.cl.
// Work-group (LANES, WAVES): 32 x 4 ROWS pixels, a tile of the list; launch (LANES tiles, WAVES OUT / OUTPUTS).
//
// LANES work-items, a wave, multiply UNIT pixels x 16 channels by 16 channels x some outputs at once (mma.clh), for two
// such units beside each other in ROWS rows. A work-item has EACH outputs of a block, one behind the other, and with
// GATED the gate behind them. The inner dimension runs over eights within taps within chunks; at stride 2 even columns
// lie before odd ones.
#if !defined(A) || !defined(B) || !defined(OUT) || !defined(OUTPUTS) || !defined(EIGHTS_AT_ONCE) || \
    !defined(STRIDE) || !defined(ROWS)
#error "conv_mma.cl needs -D A, B, OUT, OUTPUTS, EIGHTS_AT_ONCE, STRIDE, ROWS"
#endif
#include "common.clh"
#include "tile_list.clh"
#include "layer.clh"
#include "mma.clh"

#define CHUNKS ((A + B) / 8 / EIGHTS_AT_ONCE)
#define STEPS ((9 * EIGHTS_AT_ONCE + 1) / 2)
#define EACH (OUTPUTS / PARTS)
#ifdef GATED
#define MATRICES (EACH / HELD + 1)
#else
#define MATRICES (EACH / HELD)
#endif
#define READ_WIDE (STRIDE * 31 + 3)
#define READ_TALL (STRIDE * (4 * ROWS - 1) + 3)
#define PITCH (34 * STRIDE)
#define PLANE (PITCH * READ_TALL + 2)  // places of 16 bytes
#define COLUMN(x) (STRIDE == 2 ? (x) % 2 * 34 + (x) / 2 : (x))
// Offset of step j's place from the first tap's, in places.
#define TAP_AT(j) ((j) % EIGHTS_AT_ONCE * PLANE + (j) / EIGHTS_AT_ONCE / 3 * PITCH + COLUMN((j) / EIGHTS_AT_ONCE % 3))

// Loads eight channels of each input pixel of the tile; see conv_local.cl.
static inline void fetch_eights(global const ushort *a, global const ushort *b, local uint4 *tile, const int item,
                                const int first, const int top, const int left, const int in_rows, const int in_columns)
{
    for (int i = item; i < EIGHTS_AT_ONCE * READ_WIDE * READ_TALL; i += LANES * WAVES) {
        const int e = i % EIGHTS_AT_ONCE, x = i / EIGHTS_AT_ONCE % READ_WIDE, y = i / EIGHTS_AT_ONCE / READ_WIDE,
                  eight = first + e;
        const int place = least(top + y, in_rows - 1) * in_columns + least(left + x, in_columns - 1);
        tile[e * PLANE + y * PITCH + COLUMN(x)] = eight < A / 8
                                                      ? ((global const uint4 *)a)[place * (A / 8) + eight]
                                                      : ((global const uint4 *)b)[place * (B / 8) + eight - A / 8];
    }
}

// The initial sums of a work-item's product n; `bias` is that of its outputs.
static inline float4 begin(global const float *bias, const float gate_bias, const int n)
{
    const float2 v = 2 * n < EACH ? vload2(n, bias) : (float2)(gate_bias);
    return (float4)(v, v);
}

// The gate of a work-item's k-th pixel: the value after its outputs.
static inline float opening(const float4 sum, const int k)
{
    return 1.0f / (1.0f + exp(-(k ? sum.z : sum.x)));
}

static inline void put(const uint after, global ushort *to, global uchar *changed, const bool compares)
{
    if (compares && *(global const uint *)to != after) *changed = 1;
    *(global uint *)to = after;
}

kernel __attribute__((reqd_work_group_size(LANES, WAVES, 1))) void conv_mma(
    global const ushort *restrict a, global const ushort *restrict b, global const uint *restrict weight,
    global const uint *restrict gate_weight, global const float *restrict bias, const float gate_bias,
    global ushort *restrict out, const Layer layer, global const uint *restrict tiles, global const int *restrict count,
    global uchar *restrict changes)
{
    local uint4 tile[EIGHTS_AT_ONCE * PLANE];
    EXCHANGE(exchange);
    const int lane = get_local_id(0), wave = get_local_id(1), block = get_group_id(1),
              from_output = block * OUTPUTS + EACH * PART(lane);
    const int in_rows = (STRIDE * layer.height + 3) / 4 * 4 + 2;
    // The wave's first pixel in the tile.
    const int across = wave % (WAVES / 4) * 2 * UNIT, down = wave / (WAVES / 4) * ROWS;
    local const uint4 *under = tile + (STRIDE * down * PITCH + across);
    a += layer.a_first;

    for (int t = get_group_id(0); t < count[0]; t += get_num_groups(0)) {
#ifdef IMAGES
        const int which = TILE_ROW(tiles[t]) / layer.tile_rows,
                  top = (TILE_ROW(tiles[t]) - which * layer.tile_rows) * 4 * ROWS;
        global const ushort *from_a = a + which * layer.a_next;
        global ushort *to = out + which * layer.out_next;
        global uchar *marks = changes + which * layer.map_next;
#else
        const int top = TILE_ROW(tiles[t]) * 4 * ROWS;
        global const ushort *from_a = a;
        global ushort *to = out;
        global uchar *marks = changes;
#endif
        const int left = TILE_COLUMN(tiles[t]) * 32;
        float4 sum[2 * ROWS][MATRICES];  // for pixels UNIT (i % 2) .. of row i / 2
        UNROLL
        for (int n = 0; n < MATRICES; ++n) {
            const float4 v = begin(bias + from_output, gate_bias, n);
            UNROLL
            for (int i = 0; i < 2 * ROWS; ++i) sum[i][n] = v;
        }
        for (int chunk = 0; chunk < CHUNKS; ++chunk) {
            barrier(CLK_LOCAL_MEM_FENCE);
            fetch_eights(from_a, b, tile, wave * LANES + lane, chunk * EIGHTS_AT_ONCE, STRIDE * top, STRIDE * left,
                         in_rows, layer.in_columns);
            barrier(CLK_LOCAL_MEM_FENCE);
            global const uint *matrices = weight + (block * CHUNKS + chunk) * STEPS * MATRICES * MATRIX;
            UNROLL
            for (int step = 0; step < STEPS; ++step) {
                // The last eight may have no partner: the other half has weights of 0.
                const int from = TAP_AT(2 * step),
                          then = TAP_AT(2 * step + 1 < 9 * EIGHTS_AT_ONCE ? 2 * step + 1 : 2 * step);
                uint2 w[MATRICES];
                UNROLL
                for (int n = 0; n < MATRICES; ++n) w[n] = read_weights(matrices + (step * MATRICES + n) * MATRIX, lane);
                UNROLL
                for (int i = 0; i < 2 * ROWS; ++i) {
                    local const uint4 *p = under + STRIDE * (i / 2) * PITCH + i % 2 * UNIT;
                    const uint4 v = read_inputs(p + from, p + then, lane);
                    UNROLL
                    for (int n = 0; n < MATRICES; ++n) MULTIPLY_ADD(sum[i][n], v, w[n], exchange, wave, lane);
                }
            }
        }
        UNROLL
        for (int i = 0; i < 2 * ROWS * ITS; ++i) {
            const int x = left + across + i / ITS % 2 * UNIT + PIXEL(lane, i % ITS), y = top + down + i / ITS / 2;
            if (x >= layer.width || y >= layer.height) continue;
            const int place =
                ((y + 1) * layer.out_columns + x + 1) * layer.out_channels + layer.out_first + from_output;
            global uchar *mark = marks + y * (layer.out_columns - 2) + x;
#ifdef GATED
            const float open = opening(sum[i / ITS][EACH / HELD], i % ITS);
#endif
            UNROLL
            for (int n = 0; n * HELD < EACH; ++n) {
                float2 value = OF_PIXEL(sum[i / ITS][n], i % ITS);
#ifdef GATED
                value *= open;
#endif
#ifdef RELU
                value = fmax(value, 0.0f);
#endif
                put(as_uint(narrow(value)), to + place + HELD * n, mark, MARKS(changes));
            }
        }
    }
}
