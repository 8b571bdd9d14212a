// SPDX-License-Identifier: MIT
// Building block differ: the tiles where a display frame differs from the one before it.
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
#error "changed_tiles.cl needs -D SPAN=tiles of a work-item"
#endif
typedef uint8 uint8_anywhere __attribute__((aligned(4)));
typedef uint4 uint4_anywhere __attribute__((aligned(4)));

#define EXPONENT 0x7f800000u

static inline uint any4(const uint4 v)
{
    const uint2 two = v.lo | v.hi;
    return two.x | two.y;
}

// Bits in which `count` values differ; eight and four at a time, since the compiler vectorises no loop in which it may not read ahead.
static inline uint bits(global const uint *a, global const uint *b, const int count)
{
    uint8 differ = 0;
    uint rest = 0;
    int i = 0;
    for (; i + 8 <= count; i += 8) differ |= *(global const uint8_anywhere *)(a + i) ^ *(global const uint8_anywhere *)(b + i);
    uint4 four = differ.lo | differ.hi;
    for (; i + 4 <= count; i += 4) four |= *(global const uint4_anywhere *)(a + i) ^ *(global const uint4_anywhere *)(b + i);
    for (; i < count; ++i) rest |= a[i] ^ b[i];
    return any4(four) | rest;
}

// Whether one of `count` values is NaN or an infinity.
static inline uint not_finite(global const uint *a, const int count)
{
    uint8 found = 0;
    uint rest = 0;
    int i = 0;
    for (; i + 8 <= count; i += 8)
        found |= as_uint8((*(global const uint8_anywhere *)(a + i) & EXPONENT) == (uint8)(EXPONENT));
    uint4 four = found.lo | found.hi;
    for (; i + 4 <= count; i += 4) four |= as_uint4((*(global const uint4_anywhere *)(a + i) & EXPONENT) == (uint4)(EXPONENT));
    for (; i < count; ++i) rest |= (a[i] & EXPONENT) == EXPONENT;
    return any4(four) | rest;
}

// Whether one of `count` values, at most 8, is not 0; -0 counts as 0.
static inline uint moves(global const uint *a, const int count)
{
    if (count == 8) {
        const uint8 eight = *(global const uint8_anywhere *)a << 1;
        return any4(eight.lo | eight.hi);
    }
    uint any = 0;
    for (int i = 0; i < count; ++i) any |= a[i] << 1;
    return any;
}

// Compares the tiles of a row of `floats` values a pixel, one array after the other, since a processor prefetches only few streams at a time.
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
        for (int t = first; t < last; ++t) seen[t - first] |= moves(motion + 2 * (row * width + 4 * t), 2 * min(4, width - 4 * t));
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
