// SPDX-License-Identifier: MIT
// Stage erm, the attention on GPUs: `normalise` and `attend` of erm.cl in one kernel, reference stss_ref/erm.py. A
// work-group computes a tile of 4 x 4 pixels: it loads the keys of the tile and its surroundings into local memory,
// divides them by their lengths, computes 25 weights for each pixel, then the sums.
//
//  buffer    dir  shape                     content
//  key       in   padded, (KEYS)            KEncoder's result, not yet normalised
//  value     in   padded, (VALUES)          latentEncoder's result, not yet masked
//  eighth    in   padded, (16)              channel 9: the mask
//  reshaded  out  padded, (out_channels)    channels 0 .. VALUES - 1 of it
//
// `height`, `width`: at 1/8 size.  `tiles`, `count`: the tiles of 4 x 4 pixels that are computed, see tile_list.clh.
// Build -D KEYS=32 -D VALUES=64 (multiples of 8), optionally -D STORED -D MARK (change_map.clh).  Work-group (2
// VALUES); launch any number of groups.
#if !defined(KEYS) || !defined(VALUES)
#error "attend_local.cl needs -D KEYS, VALUES"
#endif
#include "common.clh"
#include "tile_list.clh"

#define KEYS8 (KEYS / 8)
#define VALUES8 (VALUES / 8)
#define WINDOW 5
#define WINDOW_TAPS (WINDOW * WINDOW)
#define READ_SIDE (4 + WINDOW - 1)  // side of a tile with the surroundings that its windows reach
#define PITCH (KEYS + 1)       // so neighbours lie in different banks
#define ITEMS (16 * VALUES8)

// Pixel of the buffers for place `i` of a tile and its surroundings; for a place beyond the frame, the frame's nearest
// pixel.
static inline int clamped_place(const int y, const int x, const int height, const int width, const int columns)
{
    return (least(most(y, 0), height - 1) + 1) * columns + least(most(x, 0), width - 1) + 1;
}

kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void attend_local(
    global const stored *restrict key, global const stored *restrict value, global const stored *restrict eighth,
    global stored *restrict reshaded, const int height, const int width, const int columns, const int out_channels,
    global const uint *restrict tiles, global const int *restrict count, global uchar *restrict changes)
{
    local float keys[READ_SIDE * READ_SIDE * PITCH], masks[READ_SIDE * READ_SIDE], weights[16 * WINDOW_TAPS];
    const int item = get_local_id(0);
    for (int t = get_group_id(0); t < count[0]; t += get_num_groups(0)) {
        const int top = 4 * TILE_ROW(tiles[t]), left = 4 * TILE_COLUMN(tiles[t]);
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int i = item; i < READ_SIDE * READ_SIDE; i += ITEMS) {
            const int y = top + i / READ_SIDE - WINDOW / 2, x = left + i % READ_SIDE - WINDOW / 2;
            const int place = clamped_place(y, x, height, width, columns);
            float8 k[KEYS8], squares = 0.0f;
#pragma unroll
            for (int c = 0; c < KEYS8; ++c) {
                k[c] = LOAD8(key, place * KEYS8 + c);
                squares += k[c] * k[c];
            }
            const float length = fmax(sqrt(sum8(squares)), 1e-12f);
#pragma unroll
            for (int c = 0; c < KEYS8; ++c) vstore8(k[c] / length, c, keys + i * PITCH);
            masks[i] = y >= 0 && x >= 0 && y < height && x < width ? LOAD(eighth, place * 16 + 9) : 0.0f;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        // w = relu(m(p + d) K(p + d) . K(p)): the mask is applied here to the keys, and beyond the frame it is 0.
        for (int i = item; i < 16 * WINDOW_TAPS; i += ITEMS) {
            const int pixel = i / WINDOW_TAPS, tap = i % WINDOW_TAPS;
            const int there = (pixel / 4 + tap / WINDOW) * READ_SIDE + pixel % 4 + tap % WINDOW;
            local const float *a = keys + there * PITCH,
                              *b = keys + ((pixel / 4 + WINDOW / 2) * READ_SIDE + pixel % 4 + WINDOW / 2) * PITCH;
            float sum = 0.0f;
#pragma unroll 8
            for (int c = 0; c < KEYS; ++c) sum += a[c] * b[c];
            const float weight = sum * masks[there];
            weights[i] = weight > 0.0f ? weight : 0.0f;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        // sum_d w(d) m V(p + d) / max(sum_d w(d), 1e-6): eight channels of a pixel; here the mask is applied to the
        // values.
        const int pixel = item / VALUES8, c = item % VALUES8, y = top + pixel / 4, x = left + pixel % 4;
        if (y < height && x < width) {
            BEGIN_PIXEL;
            float8 total = 0.0f;
            float together = 0.0f;
            for (int tap = 0; tap < WINDOW_TAPS; ++tap) {
                const float weight = weights[pixel * WINDOW_TAPS + tap];
                if (!(weight > 0.0f)) continue;
                const int v = tap / WINDOW - WINDOW / 2, u = tap % WINDOW - WINDOW / 2;
                const float mask = masks[(pixel / 4 + tap / WINDOW) * READ_SIDE + pixel % 4 + tap % WINDOW];
                total += LOAD8(value, ((y + v + 1) * columns + x + u + 1) * VALUES8 + c) * (weight * mask);
                together += weight;
            }
            PUT(total / fmax(together, 1e-6f), ((y + 1) * columns + x + 1) * (out_channels / 8) + c, reshaded);
            END_PIXEL(y * (columns - 2) + x);
        }
    }
}
