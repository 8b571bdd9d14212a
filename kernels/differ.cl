// SPDX-License-Identifier: MIT
// Building block differ: where a display frame is not what the one before it was.
//
//  buffer           dir  shape        unit
//  motion           in   (H, W, 2)    px
//  gbuffer          in   (H, W, 9)
//  nov, stencil     in   (H, W)
//  position         in   (H, W, 3)
//  *_before         in   likewise     of the frame before
//  changed          out  (H/4, W/4)   1 = something moves in the tile of 4 x 4 pixels, or a bit of it is another; sizes rounded up
//  bad              out  (arrays)     set to 1 if a value of gbuffer (1), nov (2) or stencil (3) is not finite; the caller clears it
//
// differ_color: the same for two colours (H, W, 3), without `bad`.
// Build -D SPAN=tiles of a work-item.  Launch (ceil(ceil(W / 4) / SPAN), ceil(H / 4)).
#ifndef SPAN
#error "differ.cl needs -D SPAN=tiles of a work-item"
#endif
typedef uint8 uint8_anywhere __attribute__((aligned(4)));

#define EXPONENT 0x7f800000u

static inline uint any8(const uint8 v)
{
    const uint4 four = v.lo | v.hi;
    const uint2 two = four.lo | four.hi;
    return two.x | two.y;
}

// Bits in which `count` values differ; eight at a time: the compiler makes no vectors of a loop it may not read ahead in.
static inline uint bits(global const uint *a, global const uint *b, const int count)
{
    uint8 differ = 0;
    uint rest = 0;
    int i = 0;
    for (; i + 8 <= count; i += 8) differ |= *(global const uint8_anywhere *)(a + i) ^ *(global const uint8_anywhere *)(b + i);
    for (; i < count; ++i) rest |= a[i] ^ b[i];
    return any8(differ) | rest;
}

// Whether one of `count` values is NaN or an infinity.
static inline uint not_finite(global const uint *a, const int count)
{
    uint8 found = 0;
    uint rest = 0;
    int i = 0;
    for (; i + 8 <= count; i += 8)
        found |= as_uint8((*(global const uint8_anywhere *)(a + i) & EXPONENT) == (uint8)(EXPONENT));
    for (; i < count; ++i) rest |= (a[i] & EXPONENT) == EXPONENT;
    return any8(found) | rest;
}

// The tiles of a row of `floats` values a pixel, one array after the other: few streams at a time are what a processor fetches ahead.
static inline uint compare(global const uint *now, global const uint *before, const int floats, const int row, const int first,
                           const int last, const int width, uint *seen, const bool finite)
{
    uint bad = 0;
    for (int t = first; t < last; ++t) {
        const int pixels = min(4, width - 4 * t), at = (row * width + 4 * t) * floats;
        if (finite) bad |= not_finite(now + at, pixels * floats);
        if (!seen[t - first]) seen[t - first] = bits(now + at, before + at, pixels * floats);
    }
    return bad;
}

kernel void differ(global const uint *restrict motion, global const uint *restrict gbuffer, global const uint *restrict nov,
                   global const uint *restrict stencil, global const uint *restrict position, global const uint *restrict gbuffer_before,
                   global const uint *restrict nov_before, global const uint *restrict stencil_before,
                   global const uint *restrict position_before, global uchar *restrict changed, global int *restrict bad,
                   const int height, const int width)
{
    const int columns = (width + 3) / 4, first = get_global_id(0) * SPAN, last = min(first + SPAN, columns), y = 4 * get_global_id(1);
    uint seen[SPAN];
    uint g_bad = 0, n_bad = 0, s_bad = 0;
    for (int t = first; t < last; ++t) seen[t - first] = 0;
    for (int row = y; row < y + 4 && row < height; ++row)
        for (int t = first; t < last; ++t)
            for (int i = 8 * t; i < 8 * t + 8 && i < 2 * width; ++i) seen[t - first] |= motion[2 * row * width + i] << 1;  // -0 is still
    for (int row = y; row < y + 4 && row < height; ++row) {
        g_bad |= compare(gbuffer, gbuffer_before, 9, row, first, last, width, seen, true);
        compare(position, position_before, 3, row, first, last, width, seen, false);
        n_bad |= compare(nov, nov_before, 1, row, first, last, width, seen, true);
        s_bad |= compare(stencil, stencil_before, 1, row, first, last, width, seen, true);
    }
    for (int t = first; t < last; ++t) changed[get_global_id(1) * columns + t] = seen[t - first] != 0;
    if (g_bad) atomic_or(bad + 1, 1);
    if (n_bad) atomic_or(bad + 2, 1);
    if (s_bad) atomic_or(bad + 3, 1);
}

kernel void differ_color(global const uint *restrict color, global const uint *restrict before, global uchar *restrict changed,
                         const int height, const int width)
{
    const int columns = (width + 3) / 4, first = get_global_id(0) * SPAN, last = min(first + SPAN, columns), y = 4 * get_global_id(1);
    uint seen[SPAN];
    for (int t = first; t < last; ++t) seen[t - first] = 0;
    for (int row = y; row < y + 4 && row < height; ++row) compare(color, before, 3, row, first, last, width, seen, false);
    for (int t = first; t < last; ++t) changed[get_global_id(1) * columns + t] = seen[t - first] != 0;
}
