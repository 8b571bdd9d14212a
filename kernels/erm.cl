// Stage erm, reference stss_ref/erm.py: its input at 1/8 size, and the attention. Its convolutions are conv.cl's.
//
//  buffer    dir  shape                     content
//  gbuffer   in   (H, W, 9)                 normal 3, depth, roughness, metallic, base colour 3
//  mask      in   (H, W) of MASK            1 = to be trusted
//  eighth    out  padded, (16)              both at 1/8 size: gbuffer 9, mask, zeros 6
//  key       in   padded, (KEYS)            KEncoder's result, not yet normalised
//  unit      out  padded, (KEYS)            the same divided by its length
//  value     in   padded, (VALUES)          latentEncoder's result, not yet masked
//  reshaded  out  padded, (out_channels)    channels 0 .. VALUES - 1 of it
//
// `height`, `width`: of the frame for `eighth`, whose row 0 is the frame's row `top`; else at 1/8 size, as `down`, `across`.
// Build -D KEYS=32 -D VALUES=64 (multiples of 8) -D MASK=float or uchar, optionally -D HALF.  Launch (width, height) at 1/8 size, or more.
//
// -D SKIP, optionally -D SPAN: only pixels that a change reaches, see change_map.clh; the last arguments are the maps of the inputs
// and of the output. attend's work-item then has SPAN x SPAN pixels. downsample_8 computes all and marks what came to differ.
#if !defined(KEYS) || !defined(VALUES) || !defined(MASK)
#error "erm.cl needs -D KEYS, VALUES, MASK"
#endif
#include "common.clh"
#ifdef SKIP
#include "change_map.clh"
#endif

#define KEYS8 (KEYS / 8)
#define VALUES8 (VALUES / 8)
#define WINDOW 5
#ifndef SPAN
#define SPAN 1
#endif

// The mean of pixels 8i + 3 and 8i + 4 each way; beyond the frame its last row and column are repeated (pad_to_8).
kernel void downsample_8(global const float *restrict gbuffer, global const MASK *restrict mask, global stored *restrict eighth,
                         const int height, const int width, const int down, const int across, const int columns,
                         const int top
#ifdef SKIP
                         , global uchar *restrict changes
#endif
                         )
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= across || y >= down) return;
    const int west = min(8 * x + 3, width - 1), east = min(8 * x + 4, width - 1);
    const int north = min(top + 8 * y + 3, height - 1) * width, south = min(top + 8 * y + 4, height - 1) * width;
    const int nw = north + west, ne = north + east, sw = south + west, se = south + east;
    float mean[16] __attribute__((aligned(32)));
    for (int c = 0; c < 9; ++c) {
        const float left = (gbuffer[9 * nw + c] + gbuffer[9 * sw + c]) * 0.5f;
        mean[c] = (left + (gbuffer[9 * ne + c] + gbuffer[9 * se + c]) * 0.5f) * 0.5f;
    }
    mean[9] = (((float)mask[nw] + (float)mask[sw]) * 0.5f + ((float)mask[ne] + (float)mask[se]) * 0.5f) * 0.5f;
    for (int c = 10; c < 16; ++c) mean[c] = 0.0f;
    const int to = ((y + 1) * columns + x + 1) * 2;
#ifdef SKIP
    const stored8 differs = replace8(((const float8 *)mean)[0], to, eighth, -1.0f);
    if (any_bit(differs | replace8(((const float8 *)mean)[1], to + 1, eighth, -1.0f)))
        changes[y / 4 * ((columns - 2) / 4) + x / 4] = 1;
#else
    STORE8(((const float8 *)mean)[0], to, eighth);
    STORE8(((const float8 *)mean)[1], to + 1, eighth);
#endif
}

kernel void normalise(global const stored *restrict key, global stored *restrict unit, const int height, const int width,
                      const int columns
#ifdef SKIP
                      , global const uchar *restrict key_changes, global uchar *restrict changes, const float tolerance
#endif
                      )
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
#ifdef SKIP
    const int tile = y / 4 * ((columns - 2) / 4) + x / 4;
    if (!key_changes[tile]) return;
    stored8 differs = 0;
#endif
    const int pixel = ((y + 1) * columns + x + 1) * KEYS8;
    float8 squares = 0.0f;
    for (int c = 0; c < KEYS8; ++c) {
        const float8 k = LOAD8(key, pixel + c);
        squares += k * k;
    }
    const float length = max(sqrt(sum8(squares)), 1e-12f);
#ifdef SKIP
    for (int c = 0; c < KEYS8; ++c) differs |= replace8(LOAD8(key, pixel + c) / length, pixel + c, unit, tolerance);
    if (any_bit(differs)) changes[tile] = 1;
#else
    for (int c = 0; c < KEYS8; ++c) STORE8(LOAD8(key, pixel + c) / length, pixel + c, unit);
#endif
}

// sum_d w(d) m V(p + d) / max(sum_d w(d), 1e-6), w(d) = relu(m(p + d) K(p + d) . K(p)): the mask is applied here to keys and values.
static inline void attention(global const stored *restrict unit, global const stored *restrict value,
                             global const stored *restrict eighth, global stored *restrict reshaded, const int height,
                             const int width, const int columns, const int out_channels, const int x, const int y
#ifdef SKIP
                             , global uchar *restrict changes, const float tolerance
#endif
                             )
{
    const int pixel = (y + 1) * columns + x + 1;
    float8 query[KEYS8], total[VALUES8];
    for (int c = 0; c < KEYS8; ++c) query[c] = LOAD8(unit, pixel * KEYS8 + c);
    for (int c = 0; c < VALUES8; ++c) total[c] = 0.0f;
    float weights = 0.0f;
    for (int v = max(y - WINDOW / 2, 0); v <= min(y + WINDOW / 2, height - 1); ++v)
        for (int u = max(x - WINDOW / 2, 0); u <= min(x + WINDOW / 2, width - 1); ++u) {
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
#ifdef SKIP
    stored8 differs = 0;
    for (int c = 0; c < VALUES8; ++c)
        differs |= replace8(total[c] / weights, pixel * (out_channels / 8) + c, reshaded, tolerance);
    if (any_bit(differs)) changes[y / 4 * ((columns - 2) / 4) + x / 4] = 1;
#else
    for (int c = 0; c < VALUES8; ++c) STORE8(total[c] / weights, pixel * (out_channels / 8) + c, reshaded);
#endif
}

#ifdef SKIP
// Whether a change reaches the attention of the pixels (top .. bottom, left .. right).
static inline int reached(global const uchar *unit, global const uchar *value, global const uchar *eighth, const int rows,
                          const int columns, const int top, const int bottom, const int left, const int right)
{
    const int reach = WINDOW / 2, north = top - reach, south = bottom + reach, west = left - reach, east = right + reach;
    return marked(unit, rows, columns, north, south, west, east) || marked(value, rows, columns, north, south, west, east) ||
           marked(eighth, rows, columns, north, south, west, east);
}
#endif

kernel void attend(global const stored *restrict unit, global const stored *restrict value, global const stored *restrict eighth,
                   global stored *restrict reshaded, const int height, const int width, const int columns,
                   const int out_channels
#ifdef SKIP
                   , global const uchar *restrict unit_changes, global const uchar *restrict value_changes,
                   global const uchar *restrict eighth_changes, global uchar *restrict changes, const float tolerance
#endif
                   )
{
#ifdef SKIP
    const int rows = (height + 3) / 4, tiles = (columns - 2) / 4, left = get_global_id(0) * SPAN, top = get_global_id(1) * SPAN;
    const int right = min(left + SPAN, width) - 1, bottom = min(top + SPAN, height) - 1;
    if (!reached(unit_changes, value_changes, eighth_changes, rows, tiles, top, bottom, left, right)) return;
    for (int y = top; y <= bottom; ++y)
        for (int x = left; x <= right; ++x)
            if (SPAN == 1 || reached(unit_changes, value_changes, eighth_changes, rows, tiles, y, y, x, x))
                attention(unit, value, eighth, reshaded, height, width, columns, out_channels, x, y, changes, tolerance);
#else
    const int x = get_global_id(0), y = get_global_id(1);
    if (x < width && y < height) attention(unit, value, eighth, reshaded, height, width, columns, out_channels, x, y);
#endif
}
