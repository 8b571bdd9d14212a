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
// Launch (ceil(ceil(W / 4) / SPAN), ceil(H / 4)).
#define SPAN 8
typedef uint8 uint8_anywhere __attribute__((aligned(4)));
typedef uint4 uint4_anywhere __attribute__((aligned(4)));

#define EXPONENT 0x7f800000u

static inline uint any4(const uint4 v)
{
    const uint2 two = v.lo | v.hi;
    return two.x | two.y;
}

// Bits in which `count` values, a multiple of 4, differ.
static inline uint bits(global const uint *a, global const uint *b, const int count)
{
    uint4 differ = 0;
    for (int i = 0; i < count; i += 4) differ |= *(global const uint4_anywhere *)(a + i) ^ *(global const uint4_anywhere *)(b + i);
    return any4(differ);
}

// Whether one of `count` values, a multiple of 4, is NaN or an infinity.
static inline uint not_finite(global const uint *a, const int count)
{
    uint4 found = 0;
    for (int i = 0; i < count; i += 4) {
        const uint4 v = *(global const uint4_anywhere *)(a + i) & EXPONENT;
        found |= as_uint4(v == (uint4)(EXPONENT));
    }
    return any4(found);
}

// The same for any count.
static inline uint bits_few(global const uint *a, global const uint *b, const int count)
{
    uint differ = 0;
    for (int i = 0; i < count; ++i) differ |= a[i] ^ b[i];
    return differ;
}

static inline uint not_finite_few(global const uint *a, const int count)
{
    uint found = 0;
    for (int i = 0; i < count; ++i) found |= (a[i] & EXPONENT) == EXPONENT;
    return found;
}

static inline uint moves(global const uint *motion, const int pixels)
{
    uint found = 0;
    for (int i = 0; i < 2 * pixels; ++i) found |= motion[i] << 1;  // -0 does not move
    return found;
}

kernel void differ(global const uint *restrict motion, global const uint *restrict gbuffer, global const uint *restrict nov,
                   global const uint *restrict stencil, global const uint *restrict position, global const uint *restrict gbuffer_before,
                   global const uint *restrict nov_before, global const uint *restrict stencil_before,
                   global const uint *restrict position_before, global uchar *restrict changed, global int *restrict bad,
                   const int height, const int width)
{
    const int columns = (width + 3) / 4, first = get_global_id(0) * SPAN, row = get_global_id(1);
    uint seen[SPAN];
    uint g_bad = 0, n_bad = 0, s_bad = 0;
    for (int t = 0; t < SPAN; ++t) seen[t] = 0;
    for (int y = 4 * row; y < 4 * row + 4 && y < height; ++y)
        for (int t = 0; t < SPAN && first + t < columns; ++t) {
            const int x = 4 * (first + t), p = y * width + x;
            if (x + 4 <= width) {
                g_bad |= not_finite(gbuffer + 9 * p, 36);
                n_bad |= not_finite(nov + p, 4);
                s_bad |= not_finite(stencil + p, 4);
                if (!seen[t])
                    seen[t] = moves(motion + 2 * p, 4) || bits(gbuffer + 9 * p, gbuffer_before + 9 * p, 36) ||
                              bits(nov + p, nov_before + p, 4) || bits(stencil + p, stencil_before + p, 4) ||
                              bits(position + 3 * p, position_before + 3 * p, 12);
            } else {
                const int n = width - x;
                g_bad |= not_finite_few(gbuffer + 9 * p, 9 * n);
                n_bad |= not_finite_few(nov + p, n);
                s_bad |= not_finite_few(stencil + p, n);
                seen[t] |= moves(motion + 2 * p, n) | bits_few(gbuffer + 9 * p, gbuffer_before + 9 * p, 9 * n) |
                           bits_few(nov + p, nov_before + p, n) | bits_few(stencil + p, stencil_before + p, n) |
                           bits_few(position + 3 * p, position_before + 3 * p, 3 * n);
            }
        }
    for (int t = 0; t < SPAN && first + t < columns; ++t) changed[row * columns + first + t] = seen[t] != 0;
    if (g_bad) atomic_or(bad + 1, 1);
    if (n_bad) atomic_or(bad + 2, 1);
    if (s_bad) atomic_or(bad + 3, 1);
}

kernel void differ_color(global const uint *restrict color, global const uint *restrict before, global uchar *restrict changed,
                         const int height, const int width)
{
    const int columns = (width + 3) / 4, first = get_global_id(0) * SPAN, row = get_global_id(1);
    uint seen[SPAN];
    for (int t = 0; t < SPAN; ++t) seen[t] = 0;
    for (int y = 4 * row; y < 4 * row + 4 && y < height; ++y)
        for (int t = 0; t < SPAN && first + t < columns; ++t) {
            const int x = 4 * (first + t), p = 3 * (y * width + x);
            seen[t] |= x + 4 <= width ? bits(color + p, before + p, 12) : bits_few(color + p, before + p, 3 * (width - x));
        }
    for (int t = 0; t < SPAN && first + t < columns; ++t) changed[row * columns + first + t] = seen[t] != 0;
}
