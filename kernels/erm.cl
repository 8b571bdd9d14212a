// SPDX-License-Identifier: MIT
// Stage erm, reference stss_ref/erm.py: the attention; attend_local.cl is the same for GPUs. Its convolutions are
// conv.cl's.
//
//  buffer    dir  shape                     content
//  eighth    in   padded, (16)              channel 9: the mask
//  key       in   padded, (KEYS)            KEncoder's result, not yet normalised
//  unit      out  padded, (KEYS)            the same divided by its length
//  value     in   padded, (VALUES)          latentEncoder's result, not yet masked
//  reshaded  out  padded, (out_channels)    channels 0 .. VALUES - 1 of it
//
// `height`, `width`: at 1/8 size.
// `tiles`, `count`: the tiles of 4 x 4 pixels that are computed, see tile_list.clh.
// Build -D KEYS=32 -D VALUES=64 (multiples of 8) -D WORKERS (16 or 1), optionally -D STORED.  Launch (any multiple of
// WORKERS).
//
// If MARKS(changes), the output's map, a value is compared with the stored one, and marked if bits differ
// (change_map.clh).
#if !defined(KEYS) || !defined(VALUES)
#error "erm.cl needs -D KEYS, VALUES"
#endif
#include "common.clh"
#include "tile_list.clh"

#define KEYS8 (KEYS / 8)
#define VALUES8 (VALUES / 8)
#define WINDOW 5

kernel void normalise(global const stored *restrict key, global stored *restrict unit, const int height,
                      const int width, const int columns, global const uint *restrict tiles,
                      global const int *restrict count, global uchar *restrict changes)
{
    const int2 part = part_of_list(count[0], 1);
    for (int t = part.x; t < part.y; ++t) {
        for (int i = WORKER; i < 16; i += WORKERS) {
            const int y = 4 * TILE_ROW(tiles[t]) + i / 4, x = 4 * TILE_COLUMN(tiles[t]) + i % 4;
            if (y >= height || x >= width) continue;
            const int pixel = ((y + 1) * columns + x + 1) * KEYS8;
            BEGIN_PIXEL;
            float8 squares = 0.0f;
            for (int c = 0; c < KEYS8; ++c) {
                const float8 k = LOAD8(key, pixel + c);
                squares += k * k;
            }
            const float length = max(sqrt(sum8(squares)), 1e-12f);
            for (int c = 0; c < KEYS8; ++c) PUT(LOAD8(key, pixel + c) / length, pixel + c, unit);
            END_PIXEL(y * (columns - 2) + x);
        }
    }
}

// sum_d w(d) m V(p + d) / max(sum_d w(d), 1e-6), w(d) = relu(m(p + d) K(p + d) . K(p)): here the mask is applied to
// keys and values.
kernel void attend(global const stored *restrict unit, global const stored *restrict value,
                   global const stored *restrict eighth, global stored *restrict reshaded, const int height,
                   const int width, const int columns, const int out_channels, global const uint *restrict tiles,
                   global const int *restrict count, global uchar *restrict changes)
{
    const int2 part = part_of_list(count[0], 1);
    for (int t = part.x; t < part.y; ++t) {
        for (int i = WORKER; i < 16; i += WORKERS) {
            const int y = 4 * TILE_ROW(tiles[t]) + i / 4, x = 4 * TILE_COLUMN(tiles[t]) + i % 4;
            if (y >= height || x >= width) continue;
            const int pixel = (y + 1) * columns + x + 1;
            BEGIN_PIXEL;
            float8 query[KEYS8], total[VALUES8];
            for (int c = 0; c < KEYS8; ++c) query[c] = LOAD8(unit, pixel * KEYS8 + c);
            for (int c = 0; c < VALUES8; ++c) total[c] = 0.0f;
            float weights = 0.0f;
            for (int v = most(y - WINDOW / 2, 0); v <= least(y + WINDOW / 2, height - 1); ++v)
                for (int u = most(x - WINDOW / 2, 0); u <= least(x + WINDOW / 2, width - 1); ++u) {
                    const int there = (v + 1) * columns + u + 1;
                    const float mask = LOAD(eighth, there * 16 + 9);
                    float8 products = 0.0f;
                    for (int c = 0; c < KEYS8; ++c) products += LOAD8(unit, there * KEYS8 + c) * query[c];
                    const float weight = sum8(products) * mask;
                    if (!(weight > 0.0f)) continue;
                    for (int c = 0; c < VALUES8; ++c) total[c] += LOAD8(value, there * VALUES8 + c) * (weight * mask);
                    weights += weight;
                }
            weights = max(weights, 1e-6f);
            for (int c = 0; c < VALUES8; ++c) PUT(total[c] / weights, pixel * (out_channels / 8) + c, reshaded);
            END_PIXEL(y * (columns - 2) + x);
        }
    }
}
